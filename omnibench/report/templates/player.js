"use strict";

// A player draws one run of a robot at the time that its range input names. What it reads is made by
// recording/section.py: lengths in m, angles in rad, rates in rad/s; every list of a run has one entry a frame.
function startPlayer(player) {
  const runs = Object.values(JSON.parse(document.getElementById(player.dataset.source).textContent));
  const canvas = player.querySelector("canvas"), wheels = player.querySelector(".wheels");
  const slider = player.querySelector("input"), button = player.querySelector("button");
  const output = player.querySelector("output"), key = player.querySelector(".key");
  const chosen = player.querySelector("[name=run]"), view = player.querySelector("[name=view]");
  let run = null, bars = [], playing = 0;

  function load() {
    stop();
    run = runs[chosen.selectedIndex];
    run.colours = Object.fromEntries(run.key.map(({ name, colour }) => [name, colour]));
    slider.max = run.times.length - 1;
    slider.value = 0;
    key.replaceChildren(...run.key.map(legendEntry));
    bars = makeRateBars(wheels, run);
    show();
  }

  function show() {
    const frame = Number(slider.value), [x, y, heading] = run.poses[frame];
    drawRoom(canvas, run, frame, view.value === "robot");
    bars.forEach((update) => update(frame));
    const time = `t = ${run.times[frame].toFixed(2)} s`;
    const degrees = ((heading * 180) / Math.PI).toFixed(1);
    output.textContent = `${time}: x ${x.toFixed(3)} m, y ${y.toFixed(3)} m, heading ${degrees}°`.replaceAll("-", "−");
    slider.setAttribute("aria-valuetext", time);
  }

  function stop() {
    cancelAnimationFrame(playing);
    playing = 0;
    button.textContent = "Play";
  }

  function play() {
    const last = run.times.length - 1;
    if (Number(slider.value) === last) slider.value = 0;
    const length = run.times[last] - run.times[0], speed = Math.max(1, length / 30); // half a minute at most
    const from = run.times[Number(slider.value)];
    let begun = null;
    button.textContent = "Pause";
    const step = (now) => {
      begun ??= now;
      const time = from + ((now - begun) / 1000) * speed;
      const next = run.times.findIndex((stamp) => stamp >= time);
      slider.value = next < 0 ? last : next;
      show();
      if (next < 0 || next === last) stop();
      else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  }

  button.addEventListener("click", () => (playing ? stop() : play()));
  slider.addEventListener("input", () => (stop(), show()));
  chosen.addEventListener("change", load);
  view.addEventListener("change", show);
  new ResizeObserver(() => run && show()).observe(canvas);
  load();
}

function legendEntry({ name, label, colour }) {
  const entry = document.createElement("span");
  entry.textContent = label;
  entry.className = ["scan", "map"].includes(name) ? "points" : "";
  entry.style.setProperty("--colour", colour);
  return entry;
}

// A bar for each wheel, from the middle; its target, where there is one, is a stroke across.
function makeRateBars(parent, run) {
  const title = document.createElement("h4");
  title.textContent = run.targets ? "Wheel rates; strokes: targets" : "Wheel rates";
  parent.replaceChildren(title);
  return run.rated.map((name, index) => {
    const row = document.createElement("div"), words = document.createElement("span");
    const rate = document.createElement("div"), bar = document.createElement("i"), stroke = document.createElement("b");
    rate.className = "rate";
    rate.append(bar);
    if (run.targets) rate.append(stroke);
    row.append(words, rate);
    parent.append(row);
    return (frame) => {
      const share = (value) => Math.max(-1, Math.min(1, value / run.rate_limit)) * 50;
      const measured = run.rates[frame][index];
      bar.style.left = `${50 + Math.min(0, share(measured))}%`;
      bar.style.width = `${Math.abs(share(measured))}%`;
      let text = `${name}: ${measured.toFixed(2)}`;
      if (run.targets) {
        stroke.style.left = `${50 + share(run.targets[frame][index])}%`;
        text += ` of ${run.targets[frame][index].toFixed(2)}`;
      }
      words.textContent = `${text} rad/s`.replaceAll("-", "−");
    };
  });
}

function drawRoom(canvas, run, frame, near) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width) return; // not shown
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const pen = canvas.getContext("2d"), pose = run.poses[frame];
  const [left, bottom, right, top] = near
    ? [pose[0] - 2, pose[1] - 2, pose[0] + 2, pose[1] + 2]
    : run.window;
  const scale = Math.min((width - 16) / (right - left), (height - 16) / (top - bottom));
  const place = (x, y) => [width / 2 + (x - (left + right) / 2) * scale, height / 2 - (y - (bottom + top) / 2) * scale];
  pen.scale(ratio, ratio);
  const line = (points, colour, thickness, dash = []) => {
    pen.beginPath();
    for (const [x, y] of points) pen.lineTo(...place(x, y));
    pen.strokeStyle = colour;
    pen.lineWidth = thickness;
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  };
  const dots = (flat, colour, size) => {
    pen.fillStyle = colour;
    for (let i = 0; i < flat.length; i += 2) {
      const [x, y] = place(flat[i], flat[i + 1]);
      pen.fillRect(x - size / 2, y - size / 2, size, size);
    }
  };

  for (const outline of run.plan) line(outline, run.colours.plan, 1.5);
  const past = run.scans.filter((scan) => scan.t <= run.times[frame]);
  past.slice(0, -1).forEach((scan) => dots(scan.points, run.colours.map + "66", 1.5));
  const current = past[past.length - 1];
  if (current) {
    pen.beginPath();
    for (let i = 0; i < current.points.length; i += 6) {
      pen.moveTo(...place(...current.from));
      pen.lineTo(...place(current.points[i], current.points[i + 1]));
    }
    pen.strokeStyle = run.colours.scan + "44";
    pen.lineWidth = 0.6;
    pen.stroke();
    dots(current.points, run.colours.scan, 2.4);
  }
  line(run.poses, run.colours.reference + "55", 1);
  line(run.odometry.slice(0, frame + 1), run.colours.odometry, 2, [6, 4]);
  if (run.truth) line(run.truth.slice(0, frame + 1), run.colours.truth, 1.5, [2, 3]);
  line(run.poses.slice(0, frame + 1), run.colours.reference, 2.5);
  drawRobot(pen, run, frame, place, scale);
  drawScaleBar(pen, scale, height);
}

// A disc with a stroke to the front and its wheels, seen from above.
function drawRobot(pen, run, frame, place, scale) {
  const [x, y, heading] = run.poses[frame];
  pen.save();
  pen.translate(...place(x, y));
  pen.rotate(-heading);
  pen.scale(scale, -scale); // metres, y to the left of the robot
  pen.beginPath();
  pen.arc(0, 0, run.radius, 0, 2 * Math.PI);
  pen.fillStyle = "rgba(255,255,255,0.85)";
  pen.fill();
  pen.strokeStyle = pen.fillStyle = "#1f2933";
  pen.lineWidth = 1.6 / scale;
  pen.stroke();
  for (const { radius, at, rolling, steered } of run.wheels) {
    pen.save();
    pen.translate(...at);
    pen.rotate(rolling + (steered === null ? 0 : run.steering[frame][steered]));
    pen.fillRect(-radius, -0.02, 2 * radius, 0.04);
    pen.restore();
  }
  pen.beginPath();
  pen.moveTo(run.radius, 0);
  pen.lineTo(-0.35 * run.radius, 0.4 * run.radius);
  pen.lineTo(-0.35 * run.radius, -0.4 * run.radius);
  pen.closePath();
  pen.fillStyle = run.colours.reference;
  pen.fill();
  pen.restore();
}

function drawScaleBar(pen, scale, height) {
  const length = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((metres) => metres * scale > 40) ?? 100;
  pen.fillStyle = "#1f2933";
  pen.fillRect(10, height - 12, length * scale, 3);
  pen.font = "12px system-ui, sans-serif";
  pen.fillText(`${length} m`, 10, height - 18);
}
