"use strict";
// Page of `v2vloc view`: shared state and the newest frame. panels.js fills the panels, scene.js draws the scene and heat.js
// a feature map in it, series.js draws the links over time, moments.js fetches.

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

// ---- formatting of numbers; what is not known is a dash, never a zero ----

const isKnown = (value) => value !== null && value !== undefined;
const number = (value, digits = 1) => (isKnown(value) ? value.toFixed(digits) : "–");
const ms = (value) => (isKnown(value) ? `${number(value, value < 10 ? 1 : 0)} ms` : "–");
const seconds = (value) => (value < 1 ? `${number(value, 1)} s` : value < 90 ? `${number(value, 0)} s` : `${number(value / 60, 0)} min`);
const metres = (value) => (isKnown(value) ? `${number(value, value < 1 ? 2 : 1)} m` : "–");
const bytes = (value) => {
  if (!isKnown(value)) return "–";
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
    else if (key === "click") node.addEventListener("click", value);
    else node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
}

// ---- state of the page ----

const view = {
  frame: null, points: null, zoom: 7, shift: [0, 0], turn: 0, follow: true, centre: [0, 0], hidden: new Set(["map"]), score: 0.2,
  /// The last frame with detections: shown, faded, at ticks without.
  answered: null,
  /// What was clicked: { cav } or { object } or { detection: [x, y] }.
  chosen: null,
  /// The ego that was asked for; `null`: the first with results.
  ego: null,
  cameras: [],
  /// Cameras of a live run beyond the images that the server keeps.
  imagesLeftOut: 0,
};
const order = []; // vehicles, in the order in which they were first seen: a colour each
const swatch = (cav) => {
  if (!order.includes(cav)) order.push(cav);
  return `var(--cav${order.indexOf(cav) % 6})`;
};
const ink = (cav) => colour(swatch(cav).slice(4, -1));
const ego = (frame) => frame.vehicles.find((vehicle) => vehicle.cav === frame.ego);

/// A scene frame: a JSON document after its length, then three 16-bit numbers per point.
function parse(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const frame = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { frame, points: new Int16Array(buffer.slice(4 + length)) };
}

function show({ frame, points }) {
  view.frame = frame;
  view.points = points;
  if (frame.ego) view.answered = frame;
  else if (view.answered && view.answered.capture_s > frame.capture_s) view.answered = null;
  const own = ego(frame) || (view.answered && frame.vehicles.find((vehicle) => vehicle.cav === view.answered.ego)) || frame.vehicles[0];
  const at = own && (own.pose || own.truth);
  if (at && view.follow) {
    view.centre = [at.x_m, at.y_m];
    view.turn = at.yaw_rad;
  }
  frame.vehicles.forEach((vehicle) => swatch(vehicle.cav));
  keepLinks(frame);
  root.dataset.frames = String(Number(root.dataset.frames) + 1);
  $("hint").hidden = true;
  refresh();
}

/// The frame whose detections are shown: this one, or the last that had any, with its age in seconds.
function results() {
  const { frame, answered } = view;
  if (!frame || !answered) return { of: null, age: 0 };
  return { of: answered, age: frame.capture_s - answered.capture_s };
}

/// Detections that are shown, true objects that count, and how many of each.
function judged() {
  const { of } = results();
  if (!of) return null;
  const found = of.detections.filter((box) => box.score >= view.score);
  const known = found.some((box) => isKnown(box.is_hit)) || of.truth.some((box) => box.is_counted);
  if (!known) return null;
  const hits = found.filter((box) => box.is_hit).length;
  const missed = of.truth.filter((box) => box.is_counted && !(box.found_score >= view.score)).length;
  const wrong = found.filter((box) => box.is_hit === false).length;
  return { hits, wrong, missed };
}

function refresh() {
  if (!view.frame) return;
  facts(view.frame);
  panels(view.frame);
  fetchHeat(view.frame);
  requestAnimationFrame(() => { draw(); series(); });
}
