"use strict";
// The page of `v2vloc view`: takes moments from the server, draws the newest, and keeps no more than that.

const $ = (id) => document.getElementById(id);
const root = document.documentElement;
root.dataset.errors = "0";
root.dataset.frames = "0";
addEventListener("error", (event) => fail(event.message));
addEventListener("unhandledrejection", (event) => fail(String(event.reason)));

function fail(words) {
  root.dataset.errors = String(Number(root.dataset.errors) + 1);
  root.dataset.error = words;
}

// A picture of a live run (`?frames=N`): the page counts as loaded only when so many moments have had time to come.
const still = /frames=(\d+)/.exec(location.search);
if (still) {
  const hold = document.createElement("script");
  hold.src = `hold?ms=${100 * Number(still[1]) + 1500}`;
  document.body.append(hold);
}

// ---- numbers for people ----

const number = (value, digits = 1) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const ms = (value) => (value === null || value === undefined ? "–" : `${number(value, value < 10 ? 1 : 0)} ms`);
const bytes = (value) => {
  if (value === null || value === undefined) return "–";
  for (const [unit, size] of [["MB", 1e6], ["kB", 1e3]]) if (value >= size) return `${number(value / size)} ${unit}`;
  return `${value} B`;
};
const words = (reason) => String(reason).replaceAll("_", " ");
const colour = (name) => getComputedStyle(root).getPropertyValue(name).trim();

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "swatch") node.style.setProperty("--swatch", value);
    else if (key === "width") node.style.width = value;
    else node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

// ---- the state of the page ----

const view = { frame: null, points: null, zoom: 7, shift: [0, 0], turn: 0, follow: true, centre: [0, 0], hidden: new Set() };
const order = []; // vehicles, in the order in which they were first seen: a colour each
const swatch = (cav) => {
  if (!order.includes(cav)) order.push(cav);
  return `var(--cav${order.indexOf(cav) % 6})`;
};
const ink = (cav) => colour(swatch(cav).slice(4, -1));

/// A moment: a JSON document behind its length, then three 16-bit numbers per point.
function show(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const raw = buffer.slice(4 + length);
  view.frame = frame;
  view.points = new Int16Array(raw);
  const ego = frame.vehicles.find((vehicle) => vehicle.cav === frame.ego) || frame.vehicles[0];
  const at = ego && (ego.pose || ego.truth);
  if (at && view.follow) {
    view.centre = [at.x_m, at.y_m];
    view.turn = at.yaw_rad;
  }
  frame.vehicles.forEach((vehicle) => swatch(vehicle.cav));
  root.dataset.frames = String(Number(root.dataset.frames) + 1);
  $("hint").hidden = true;
  facts(frame);
  panels(frame);
  requestAnimationFrame(draw);
}

function facts(frame) {
  $("time").textContent = `${number(frame.capture_s, 1)} s`;
  $("method").textContent = frame.method || "–";
  $("latency").textContent = ms(frame.latency_ms);
  $("detected").textContent = `${frame.detections.length} detected, ${frame.truth.length} there`;
  $("detected").title = "boxes detected; all that vehicles annotate, in range or not";
}

// ---- panels ----

function panels(frame) {
  $("vehicles").replaceChildren(...frame.vehicles.map((vehicle) => vehicleCard(vehicle, frame.ego)));
  legend(frame);
  table("links", ["from", "latency", "size", "age", ""], frame.links.map((link) => [
    link.from,
    link.latency_ms === null ? "–" : `${ms(link.latency_ms)}`,
    bytes(link.wire_bytes),
    ms(link.age_ms),
    link.is_fused ? "fused" : [link.skipped ? words(link.skipped) : "silent", "bad"],
  ]), "Nobody sends to the ego.");
  stages(frame);
  table("messages", ["topic", "sent", "used", "dropped"], messageRows(frame.messages), "Nothing counted yet.");
  const rows = frame.processes.flatMap((process) =>
    process.stages.map((stage) => [`${process.process} · ${stage.stage}`, ms(stage.p50_ms), ms(stage.p95_ms)]));
  table("processes", ["", "p50", "p95"], rows, "No process has told yet.");
}

function vehicleCard(vehicle, ego) {
  const known = vehicle.confidence !== null;
  const said = known ? `confidence ${number(vehicle.confidence, 2)}` : `no pose${vehicle.no_pose ? `: ${words(vehicle.no_pose)}` : ""}`;
  const error = vehicle.error_m === null ? "" : `, ${number(vehicle.error_m, 2)} m off`;
  return element("div", { class: "vehicle", swatch: swatch(vehicle.cav) },
    element("p", {}, element("b", {}, vehicle.cav + (vehicle.cav === ego ? " (ego)" : "")), element("small", {}, said + error)),
    element("div", { class: "bar" }, element("i", { width: `${100 * (vehicle.confidence || 0)}%` })));
}

/// A topic's line: what its sender counts, and what is lost on the way to those who hear it.
function messageRows(messages) {
  const topics = new Map();
  for (const { topic, to, sent, received, dropped } of messages) {
    const line = topics.get(topic) || { sent: 0, used: 0, receivers: 0, dropped: 0, reasons: new Set() };
    topics.set(topic, line);
    line.sent += sent;
    if (to !== null) { line.used += received; line.receivers += 1; }
    for (const [reason, count] of Object.entries(dropped)) if (count > 0) { line.dropped += count; line.reasons.add(words(reason)); }
  }
  return [...topics].filter(([, line]) => line.sent + line.used + line.dropped > 0).map(([topic, line]) => [
    topic, line.sent, line.receivers > 1 ? `${line.used} by ${line.receivers}` : line.used,
    line.dropped ? [`${line.dropped} ${[...line.reasons].join(", ")}`, "bad"] : 0,
  ]);
}

function table(id, heads, rows, empty) {
  if (!rows.length) return $(id).replaceChildren(element("caption", { class: "empty" }, empty));
  const cell = (value) => (Array.isArray(value) ? element("td", { class: value[1] }, value[0]) : element("td", {}, String(value)));
  $(id).replaceChildren(
    element("thead", {}, element("tr", {}, ...heads.map((head) => element("th", {}, head)))),
    element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map(cell)))));
}

const STAGE_COLOURS = ["--cav5", "--cav0", "--cav1", "--cav3", "--cav2", "--cav4", "--detection"];

/// The time from capture to detections: what the ego tells of, and before it what its agent took, sensors included.
function stages(frame) {
  const told = frame.stages.map(({ stage, nanos }) => [stage, nanos / 1e6]);
  const rest = frame.latency_ms === null ? null : frame.latency_ms - told.reduce((sum, [, time]) => sum + time, 0);
  const parts = (rest !== null && rest > 0 ? [["agent", rest]] : []).concat(told).filter(([, time]) => time >= 0.05);
  if (!parts.length) return $("stages").replaceChildren(element("p", { class: "empty" }, "No detections of this moment."));
  const sum = parts.reduce((total, [, time]) => total + time, 0);
  const shade = (index) => `var(${STAGE_COLOURS[index % STAGE_COLOURS.length]})`;
  $("stages").replaceChildren(
    element("div", { class: "flow" }, ...parts.map(([stage, time], index) =>
      element("i", { swatch: shade(index), width: `${100 * time / sum}%`, title: `${stage}: ${ms(time)}` }))),
    element("div", { class: "keys" }, ...parts.map(([stage, time], index) =>
      element("div", {}, element("span", { swatch: shade(index) }, stage), ms(time)))));
}

let shown = "";
function legend(frame) {
  const sources = [...new Set(frame.detections.map((box) => box.source || "fused"))].sort();
  const entries = [["truth", "truth", "var(--truth)", ""]]
    .concat(sources.map((source) => [`detections ${source}`, source === "fused" ? "detections" : `seen by ${source}`, source === "fused" ? "var(--detection)" : swatch(source), ""]))
    .concat(frame.single.length ? [["single", "sent boxes", "var(--faint)", "dashed"]] : [])
    .concat(frame.vehicles.map((vehicle) => [`points ${vehicle.cav}`, `points ${vehicle.cav}`, swatch(vehicle.cav), "dots"]));
  const key = JSON.stringify(entries);
  if (key === shown) return;
  shown = key;
  $("legend").replaceChildren(...entries.map(([layer, name, shade, kind]) => {
    const box = element("input", { type: "checkbox" });
    box.checked = !view.hidden.has(layer);
    box.addEventListener("change", () => {
      if (box.checked) view.hidden.delete(layer); else view.hidden.add(layer);
      draw();
    });
    return element("label", { swatch: shade }, box, element("i", { class: kind }), name);
  }));
}

// ---- the scene ----

const canvas = $("scene");

function draw() {
  const frame = view.frame;
  const scale = devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (!width || !height) return;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.fillStyle = colour("--sheet");
  pen.fillRect(0, 0, width, height);
  // World to screen: the ego's heading points up.
  const [cosine, sine] = [Math.cos(view.turn), Math.sin(view.turn)];
  const middle = [width / 2 + view.shift[0], height * 0.55 + view.shift[1]];
  const place = (x, y) => {
    const [dx, dy] = [x - view.centre[0], y - view.centre[1]];
    return [middle[0] - view.zoom * (cosine * dy - sine * dx), middle[1] - view.zoom * (cosine * dx + sine * dy)];
  };
  rings(pen, middle, width, height);
  if (!frame) return;
  let offset = 0;
  for (const vehicle of frame.vehicles) {
    if (vehicle.world_from_lidar && !view.hidden.has(`points ${vehicle.cav}`)) points(pen, vehicle, offset, place, width, height);
    offset += 3 * vehicle.points;
  }
  if (!view.hidden.has("truth")) frame.truth.forEach((box) => outline(pen, box, place, colour("--truth"), 1.5, true));
  if (!view.hidden.has("single")) frame.single.forEach((box) => outline(pen, box, place, ink(box.source), 1, false, [4, 3]));
  for (const box of frame.detections) {
    const source = box.source || "fused";
    if (view.hidden.has(`detections ${source}`)) continue;
    pen.globalAlpha = 0.45 + 0.55 * (box.score || 0);
    outline(pen, box, place, box.source ? ink(box.source) : colour("--detection"), 2, false);
    pen.globalAlpha = 1;
  }
  frame.vehicles.forEach((vehicle) => vehicleMark(pen, vehicle, place));
}

function rings(pen, middle, width, height) {
  pen.strokeStyle = colour("--grid");
  pen.fillStyle = colour("--faint");
  pen.lineWidth = 1;
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  const step = [5, 10, 20, 50, 100].find((metres) => metres * view.zoom > 70) || 200;
  const furthest = Math.hypot(width, height) / view.zoom;
  for (let radius = step; radius < furthest; radius += step) {
    pen.beginPath();
    pen.arc(middle[0], middle[1], radius * view.zoom, 0, 2 * Math.PI);
    pen.stroke();
    pen.fillText(`${radius} m`, middle[0], middle[1] - radius * view.zoom - 4);
  }
}

function points(pen, vehicle, offset, place, width, height) {
  const m = vehicle.world_from_lidar;
  pen.fillStyle = ink(vehicle.cav);
  pen.globalAlpha = 0.55;
  const size = view.zoom > 14 ? 2 : 1.2;
  for (let index = offset; index < offset + 3 * vehicle.points; index += 3) {
    const [x, y, z] = [view.points[index] / 100, view.points[index + 1] / 100, view.points[index + 2] / 100];
    const [u, v] = place(m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7]);
    if (u >= 0 && v >= 0 && u < width && v < height) pen.fillRect(u, v, size, size);
  }
  pen.globalAlpha = 1;
}

function outline(pen, box, place, shade, line, filled, dash = []) {
  const [x, y] = box.center_m;
  const [cosine, sine] = [Math.cos(box.heading_rad), Math.sin(box.heading_rad)];
  const [length, width] = [box.size_m[0] / 2, box.size_m[1] / 2];
  const corner = (a, b) => place(x + a * length * cosine - b * width * sine, y + a * length * sine + b * width * cosine);
  pen.beginPath();
  [[1, 1], [1, -1], [-1, -1], [-1, 1]].forEach(([a, b], index) => pen[index ? "lineTo" : "moveTo"](...corner(a, b)));
  pen.closePath();
  // The nose: from the middle to the front.
  const [front, heart] = [corner(1, 0), corner(0.4, 0)];
  pen.moveTo(...heart);
  pen.lineTo(...front);
  pen.strokeStyle = shade;
  pen.lineWidth = line;
  pen.setLineDash(dash);
  pen.stroke();
  pen.setLineDash([]);
  if (filled) {
    const alpha = pen.globalAlpha;
    pen.globalAlpha = 0.14;
    pen.fillStyle = shade;
    pen.fill();
    pen.globalAlpha = alpha;
  }
}

/// Where a vehicle believes to be, a ring for its confidence, and a line to where it is.
function vehicleMark(pen, vehicle, place) {
  const at = vehicle.pose || vehicle.truth;
  if (!at) return;
  const shade = ink(vehicle.cav);
  const [u, v] = place(at.x_m, at.y_m);
  const [a, b] = place(at.x_m + 3 * Math.cos(at.yaw_rad), at.y_m + 3 * Math.sin(at.yaw_rad));
  pen.strokeStyle = shade;
  pen.fillStyle = vehicle.pose ? shade : colour("--sheet");
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(u, v);
  pen.lineTo(a, b);
  pen.stroke();
  pen.beginPath();
  pen.arc(u, v, 5, 0, 2 * Math.PI);
  pen.fill();
  pen.stroke();
  if (vehicle.pose) {
    pen.beginPath();
    pen.arc(u, v, 11, -Math.PI / 2, -Math.PI / 2 + 2 * Math.PI * vehicle.confidence);
    pen.lineWidth = 3;
    pen.stroke();
  }
  if (vehicle.pose && vehicle.truth && vehicle.error_m > 0.5) {
    pen.lineWidth = 1;
    pen.setLineDash([3, 3]);
    pen.beginPath();
    pen.moveTo(u, v);
    pen.lineTo(...place(vehicle.truth.x_m, vehicle.truth.y_m));
    pen.stroke();
    pen.setLineDash([]);
  }
  pen.fillStyle = colour("--ink");
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(vehicle.cav, u + 15, v - 8);
}

// ---- moving about ----

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
});
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
  const wide = fingers.size > 1 ? apart() : 0;
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  if (fingers.size > 1) zoom(apart() / wide);
  else view.shift = [view.shift[0] + event.clientX - before[0], view.shift[1] + event.clientY - before[1]];
  draw();
});
for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY / 600));
}, { passive: false });

function zoom(factor) {
  if (!Number.isFinite(factor)) return;
  const before = view.zoom;
  view.zoom = Math.min(60, Math.max(1, view.zoom * factor));
  view.shift = view.shift.map((pixels) => pixels * view.zoom / before);
  draw();
}
$("closer").addEventListener("click", () => zoom(1.4));
$("wider").addEventListener("click", () => zoom(1 / 1.4));
$("follow").addEventListener("click", () => {
  view.follow = !view.follow;
  $("follow").setAttribute("aria-pressed", String(view.follow));
  if (view.follow) view.shift = [0, 0];
  draw();
});
addEventListener("resize", () => { draw(); spark(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { draw(); spark(); });

// ---- where moments come from ----

function state(mode, text) {
  root.dataset.mode = mode;
  $("state").textContent = text;
}

function hint(text) {
  $("hint").textContent = text;
  $("hint").hidden = false;
}

/// Live: moments as they come, each behind its length; the server keeps only the newest for us.
async function live() {
  const answer = await fetch(`live${location.search}`);
  const reader = answer.body.getReader();
  let rest = new Uint8Array(0);
  state("live", "live");
  hint("Waiting for the first detections.");
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    const joined = new Uint8Array(rest.length + value.length);
    joined.set(rest);
    joined.set(value, rest.length);
    rest = joined;
    let newest = null;
    while (rest.length >= 4) {
      const length = new DataView(rest.buffer, rest.byteOffset).getUint32(0, true);
      if (rest.length < 4 + length) break;
      if (length) newest = rest.slice(4, 4 + length);
      rest = rest.slice(4 + length);
    }
    if (newest) show(newest.buffer);
  }
}

async function watch() {
  for (;;) {
    await live().catch(() => {});
    state("ended", still ? "live, stopped" : "the run is gone; trying again");
    if (still) return;
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}

const tape = { timeline: [], at: -1, wanted: 0, busy: false, playing: null };

/// Recorded: one moment at a time; while one is fetched only the last wish counts.
async function seek(index) {
  tape.wanted = Math.min(tape.timeline.length - 1, Math.max(0, index));
  $("seek").value = String(tape.wanted);
  if (tape.busy) return;
  tape.busy = true;
  try {
    while (tape.at !== tape.wanted) {
      const next = tape.wanted;
      const answer = await fetch(`frame/${next}`);
      if (!answer.ok) throw new Error(await answer.text());
      show(await answer.arrayBuffer());
      tape.at = next;
      $("moment").textContent = `${next + 1} of ${tape.timeline.length}`;
      spark();
    }
  } finally {
    tape.busy = false;
  }
}

function play(on) {
  clearInterval(tape.playing);
  tape.playing = on ? setInterval(() => {
    if (tape.wanted + 1 >= tape.timeline.length) play(false); else seek(tape.wanted + 1);
  }, 100) : null;
  $("play").textContent = on ? "pause" : "play";
}

/// Latency over the run; gaps are moments without detections.
function spark() {
  const chart = $("spark");
  const [scale, width, height] = [devicePixelRatio || 1, chart.clientWidth, 44];
  if (!width || !tape.timeline.length) return;
  chart.width = width * scale;
  chart.height = height * scale;
  const pen = chart.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  const times = tape.timeline.map((moment) => moment.latency_ms);
  const most = Math.max(1, ...times.filter((time) => time !== null));
  const x = (index) => 8 + (width - 16) * (times.length > 1 ? index / (times.length - 1) : 0.5);
  const y = (time) => height - 4 - (height - 18) * time / most;
  pen.fillStyle = colour("--faint");
  pen.font = "11px system-ui, sans-serif";
  pen.fillText(`latency, up to ${ms(most)}`, 8, 10);
  const bar = Math.max(1, Math.min(10, (width - 16) / times.length - 1));
  times.forEach((time, index) => {
    pen.fillStyle = time === null ? colour("--bad") : colour("--accent");
    pen.globalAlpha = index === tape.at ? 1 : 0.45;
    const top = time === null ? height - 7 : y(time);
    pen.fillRect(x(index) - bar / 2, top, bar, height - 4 - top);
  });
  pen.globalAlpha = 1;
}

async function begin() {
  const run = await (await fetch("run")).json();
  $("run").textContent = run.run;
  document.title = `${run.run} · v2vloc`;
  if (run.mode === "live") return watch();
  tape.timeline = run.timeline;
  $("timeline").hidden = false;
  $("seek").max = String(run.timeline.length - 1);
  $("seek").addEventListener("input", () => { play(false); seek(Number($("seek").value)); });
  $("play").addEventListener("click", () => play(!tape.playing));
  addEventListener("keydown", (event) => {
    if (event.target.tagName === "BUTTON" || event.target.tagName === "INPUT") return;
    if (event.key === " ") { event.preventDefault(); play(!tape.playing); }
    if (event.key === "ArrowRight") seek(tape.wanted + 1);
    if (event.key === "ArrowLeft") seek(tape.wanted - 1);
  });
  state("recorded", "recorded");
  const asked = /at=(\d+)/.exec(location.search);
  await seek(asked ? Number(asked[1]) : 0);
}

begin().catch((error) => { fail(String(error)); state("ended", "no answer from v2vloc view"); });
