"use strict";

// Every grid of plots as one picture: titles, plots and legend. What it reads is made by figure_files.py.
const FONT = 'system-ui, "Segoe UI", "Helvetica Neue", "Liberation Sans", Arial, sans-serif';
const WIDTHS = { 1: 900, 2: 520, 3: 380 };
const GAP = 20, TITLE = 26, LEGEND = 26, SCALE = 2;
const DASHES = { solid: "none", dash: "7 4", dot: "2 3", dashdot: "7 3 2 3" };

async function drawAll(grids) {
  for (const grid of grids) {
    const svg = await picture(grid);
    keep(`${grid.name}.svg`, svg);
    keep(`${grid.name}.png`, await pixels(svg));
  }
  document.body.dataset.done = grids.length;
}

function keep(name, content) {
  const place = document.createElement("pre");
  place.dataset.name = name;
  place.textContent = content.startsWith("data:") ? content.split(",")[1] : btoa(bytes(content));
  document.body.append(place);
}

// A character for each byte of UTF-8: one by one, as a call with a million arguments overflows the stack.
function bytes(text) {
  return Array.from(new TextEncoder().encode(text), (byte) => String.fromCharCode(byte)).join("");
}

async function picture({ figures, columns, legend }) {
  const width = WIDTHS[columns], across = Math.min(columns, figures.length), parts = [];
  let top = GAP;
  for (let first = 0; first < figures.length; first += columns) {
    const row = figures.slice(first, first + columns);
    const titles = row.map((figure) => wrapped(figure.title, width / 7.6));
    const lines = Math.max(...titles.map((title) => title.length));
    for (const [column, figure] of row.entries()) {
      const left = GAP + column * (width + GAP);
      titles[column].forEach((words, line) => parts.push(label(left, top + 14 + 18 * line, words, 14, 600)));
      parts.push(await plot(figure, left, top + 8 + 18 * lines, width));
    }
    top += 8 + 18 * lines + Math.max(...row.map((figure) => figure.height)) + GAP;
  }
  const total = across * (width + GAP) + GAP;
  let left = GAP;
  for (const { label: words, colour, dash } of legend) {
    const length = 40 + 7.4 * words.length;
    if (left > GAP && left + length > total) [left, top] = [GAP, top + LEGEND];
    parts.push(`<line x1="${left}" x2="${left + 26}" y1="${top + 4}" y2="${top + 4}" stroke="${colour}" stroke-width="3" stroke-dasharray="${DASHES[dash]}"/>`);
    parts.push(label(left + 32, top + 9, words, 13, 400));
    left += length + 12;
  }
  const height = top + (legend.length ? LEGEND : 0);
  const head = `<svg xmlns="http://www.w3.org/2000/svg" width="${total}" height="${height}" viewBox="0 0 ${total} ${height}">`;
  return `${head}<rect width="100%" height="100%" fill="white"/>${parts.join("")}</svg>`;
}

async function plot({ data, layout, height }, left, top, width) {
  const url = await Plotly.toImage({ data, layout: { ...layout, width, height } }, { format: "svg", width, height });
  const svg = decodeURIComponent(url.slice(url.indexOf(",") + 1));
  return svg.replace("<svg ", `<svg x="${left}" y="${top}" `);
}

function wrapped(words, length) {
  const lines = [""];
  for (const word of words.split(" ")) {
    if (lines.at(-1) && lines.at(-1).length + word.length > length) lines.push("");
    lines[lines.length - 1] += `${lines.at(-1) ? " " : ""}${word}`;
  }
  return lines;
}

function label(x, y, words, size, weight) {
  const safe = words.replace(/&/g, "&amp;").replace(/</g, "&lt;");
  return `<text x="${x}" y="${y}" font-family='${FONT}' font-size="${size}" font-weight="${weight}" fill="#1f2933">${safe}</text>`;
}

async function pixels(svg) {
  const image = new Image();
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(svg)}`;
  await image.decode();
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [SCALE * image.width, SCALE * image.height];
  canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
  return canvas.toDataURL("image/png");
}
