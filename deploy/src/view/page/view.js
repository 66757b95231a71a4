"use strict";
// Page of `v2vloc view`: shared state, and the panels beside the scene. scene.js draws, moments.js fetches.

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

// Screenshot of a live run (`?frames=N`): the page counts as loaded only after the time of so many frames.
const still = /frames=(\d+)/.exec(location.search);
if (still) {
  const hold = document.createElement("script");
  hold.src = `hold?ms=${100 * Number(still[1]) + 1500}`;
  document.body.append(hold);
}

// ---- formatting of numbers ----

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

// ---- state of the page ----

const view = { frame: null, points: null, zoom: 7, shift: [0, 0], turn: 0, follow: true, centre: [0, 0], hidden: new Set() };
const order = []; // vehicles, in the order in which they were first seen: a colour each
const swatch = (cav) => {
  if (!order.includes(cav)) order.push(cav);
  return `var(--cav${order.indexOf(cav) % 6})`;
};
const ink = (cav) => colour(swatch(cav).slice(4, -1));

/// A scene frame: a JSON document after its length, then three 16-bit numbers per point.
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
  const { answered, ticks, rate_hz: rate } = frame.pace;
  const share = ticks ? ` (${number(100 * answered / ticks, 0)} %)` : "";
  $("answered").textContent = `${answered}/${ticks}${share}${rate === null ? "" : `, ${number(rate, 1)} Hz`}`;
  $("detected").textContent = `${frame.detections.length} detected, ${frame.truth.length} there`;
  $("detected").title = "boxes detected; all that vehicles annotate, in range or not";
}

// ---- panels ----

function panels(frame) {
  $("vehicles").replaceChildren(...frame.vehicles.map((vehicle) => vehicleCard(vehicle, frame.ego)));
  legend(frame);
  table("links", ["from", "latency", "size", "age", "clock", "trust", ""], frame.links.map((link) => [
    link.from,
    link.latency_ms === null ? "–" : `${ms(link.latency_ms)}`,
    bytes(link.wire_bytes),
    ms(link.age_ms),
    ms(link.clock_ms),
    number(link.trust, 2),
    link.is_fused ? "fused" : [[link.skipped || "silent", link.misbehaviour].filter(Boolean).map(words).join(": "), "bad"],
  ]), "No neighbour sends to the ego.");
  stages(frame);
  table("messages", ["topic", "sent", "used", "dropped"], messageRows(frame.messages), "Nothing counted yet.");
  const rows = frame.processes.flatMap((process) =>
    process.stages.map((stage) => [`${process.process} · ${stage.stage}`, ms(stage.p50_ms), ms(stage.p95_ms)]));
  table("processes", ["", "p50", "p95"], rows, "No process has reported yet.");
}

function vehicleCard(vehicle, ego) {
  const known = vehicle.confidence !== null;
  const status = known ? `confidence ${number(vehicle.confidence, 2)}` : `no pose${vehicle.no_pose ? `: ${words(vehicle.no_pose)}` : ""}`;
  const error = vehicle.error_m === null ? "" : `, ${number(vehicle.error_m, 2)} m off`;
  return element("div", { class: "vehicle", swatch: swatch(vehicle.cav) },
    element("p", {}, element("b", {}, vehicle.cav + (vehicle.cav === ego ? " (ego)" : "")), element("small", {}, status + error)),
    element("div", { class: "bar" }, element("i", { width: `${100 * (vehicle.confidence || 0)}%` })));
}

/// Row of a topic: the counters of its sender, and the losses at its receivers.
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

/// Time from capture to detections: the stages of the ego, and before them those of its agent.
function stages(frame) {
  const timings = frame.stages.map(({ stage, nanos }) => [stage, nanos / 1e6]);
  const rest = frame.latency_ms === null ? null : frame.latency_ms - timings.reduce((sum, [, time]) => sum + time, 0);
  const posed = frame.posed_ms !== null;
  const marks = [["sweep", frame.swept_ms], [frame.swept_ms === null ? "sweep and pose" : "pose", frame.posed_ms], [posed ? "map" : "agent", rest]];
  let before = 0;
  const agent = marks.flatMap(([stage, until]) => {
    if (until === null || until <= before) return [];
    const time = until - before;
    before = until;
    return [[stage, time]];
  });
  const parts = agent.concat(timings).filter(([, time]) => time >= 0.05);
  if (!parts.length) return $("stages").replaceChildren(element("p", { class: "empty" }, "No detections in this frame."));
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
