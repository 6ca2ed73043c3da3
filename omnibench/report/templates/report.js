"use strict";

// One plot after the other, so that the page can be read and scrolled while they are drawn; folded ones last.
async function drawPlots() {
  await loadLibrary();
  const folded = (canvas) => Number(canvas.closest("details:not([open])") !== null);
  for (const canvas of [...document.querySelectorAll(".canvas")].sort((a, b) => folded(a) - folded(b))) {
    const { data, layout } = JSON.parse(document.getElementById(canvas.dataset.source).textContent);
    await Plotly.newPlot(canvas, data, layout, PLOT_OPTIONS);
    await new Promise((resolve) => setTimeout(resolve));
  }
  document.body.dataset.plots = "drawn";
}

// A legend switches its traces in every plot beside it.
function toggle(button) {
  const shown = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(shown));
  for (const canvas of button.closest(".figures").querySelectorAll(".canvas")) {
    const traces = (canvas.data || []).map((trace, index) => (trace.legendgroup === button.dataset.key ? index : -1));
    const affected = traces.filter((index) => index >= 0);
    if (affected.length) Plotly.restyle(canvas, { visible: shown }, affected);
  }
}

// One option of a choice is shown; its plots were drawn without knowing their width.
function choose(choice) {
  const chosen = choice.querySelector("select").selectedIndex;
  [...choice.querySelectorAll(":scope > .option")].forEach((option, index) => (option.hidden = index !== chosen));
  fitPlots(choice);
}

function fitPlots(part) {
  for (const canvas of part.querySelectorAll(".canvas")) {
    if (canvas.data && canvas.offsetParent) Plotly.Plots.resize(canvas);
  }
}

// A link to a part that is folded away opens it.
function openTarget() {
  const target = document.getElementById(location.hash.slice(1));
  if (!target) return;
  for (const fold of target.querySelectorAll(":scope > details.fold")) fold.open = true;
  for (let fold = target.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  target.scrollIntoView();
}

function copy(button) {
  const code = button.parentElement.querySelector("code");
  const selection = window.getSelection();
  selection.selectAllChildren(code);
  const done = document.execCommand("copy"); // works from file:// too, where the clipboard API may not
  button.textContent = done ? "Copied" : "Selected";
  setTimeout(() => (button.textContent = "Copy"), 1500);
}

function markCurrentSection() {
  const links = new Map();
  for (const link of document.querySelectorAll(".contents a")) links.set(link.hash.slice(1), link);
  const sections = [...document.querySelectorAll("main section")].filter((section) => links.has(section.id));
  const update = () => {
    const passed = sections.filter((section) => section.getBoundingClientRect().top < 120);
    for (const link of links.values()) link.removeAttribute("aria-current");
    if (passed.length) links.get(passed[passed.length - 1].id).setAttribute("aria-current", "true");
  };
  document.addEventListener("scroll", update, { passive: true });
  update();
}

// Paper is narrower than most screens: plots are redrawn for it, and back afterwards.
const PAPER_WIDTH = { "columns-1": 680, "columns-2": 335, "columns-3": 220 };
window.addEventListener("beforeprint", () => {
  for (const element of document.querySelectorAll("details")) element.open = true;
  for (const canvas of document.querySelectorAll(".canvas")) {
    const grid = canvas.closest(".grid");
    const width = Object.entries(PAPER_WIDTH).find(([name]) => grid.classList.contains(name))[1];
    Plotly.relayout(canvas, { width, autosize: false });
  }
});
window.addEventListener("afterprint", () => {
  for (const canvas of document.querySelectorAll(".canvas")) Plotly.relayout(canvas, { width: null, autosize: true });
});

for (const button of document.querySelectorAll(".legend button")) button.addEventListener("click", () => toggle(button));
for (const button of document.querySelectorAll(".copy")) button.addEventListener("click", () => copy(button));
for (const choice of document.querySelectorAll(".choice")) {
  choice.querySelector("select").addEventListener("change", () => choose(choice));
  choose(choice);
}
for (const fold of document.querySelectorAll("details")) fold.addEventListener("toggle", () => fold.open && fitPlots(fold));
window.addEventListener("hashchange", openTarget);
for (const player of document.querySelectorAll(".player")) startPlayer(player);
markCurrentSection();
openTarget();
drawPlots();
