"use strict";
// The scene from above, and its navigation.

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
  drawHeat(pen, frame, place, scale);
  let offset = 0;
  for (const vehicle of frame.vehicles) {
    if (vehicle.world_from_lidar && !view.hidden.has(`points ${vehicle.cav}`)) points(pen, vehicle, offset, place, width, height);
    offset += 3 * vehicle.points;
  }
  const { of, age } = results();
  const result = of || frame;
  // The result of an earlier tick is faded.
  const fade = age > 0.001 ? 0.35 : 1;
  const own = ego(result);
  if (result.area && own && own.world_from_lidar && !view.hidden.has("area")) area(pen, result.area, own.world_from_lidar, place);
  pen.globalAlpha = fade;
  for (const box of frame.ego ? frame.truth : (result.truth.length ? result.truth : frame.truth)) {
    const isMissed = box.is_counted && !(box.found_score >= view.score);
    if (view.hidden.has(isMissed ? "missed" : "truth")) continue;
    outline(pen, box, place, colour("--truth"), isMissed ? 2.5 : 1, !isMissed, isMissed ? [5, 3] : [], isChosen({ object: box.id }));
  }
  if (!view.hidden.has("single")) result.single.forEach((box) => outline(pen, box, place, ink(box.source), 1, false, [1, 3]));
  for (const box of result.detections) {
    if (box.score < view.score || view.hidden.has(box.is_hit === false ? "wrong" : "hit")) continue;
    pen.globalAlpha = fade * (0.5 + 0.5 * box.score);
    outline(pen, box, place, colour(box.is_hit === false ? "--wrong" : "--hit"), 2, false, [], view.chosen && view.chosen.box === box);
  }
  pen.globalAlpha = fade;
  if (!view.hidden.has("tracks")) result.tracks.forEach((track) => trail(pen, track, place));
  pen.globalAlpha = 1;
  frame.vehicles.forEach((vehicle) => vehicleMark(pen, vehicle, place));
}

const isChosen = (what) => view.chosen && isKnown(what.object) && view.chosen.object === what.object;

/// World position of a point of a vehicle's LiDAR frame.
const placed = (m, x, y) => [m[0] * x + m[1] * y + m[3], m[4] * x + m[5] * y + m[7]];

/// Rectangle in which the ego detects.
function area(pen, { x_m: [x0, x1], y_m: [y0, y1] }, m, place) {
  pen.beginPath();
  [[x0, y0], [x1, y0], [x1, y1], [x0, y1]].forEach(([x, y], index) => pen[index ? "lineTo" : "moveTo"](...place(...placed(m, x, y))));
  pen.closePath();
  pen.strokeStyle = colour("--area");
  pen.lineWidth = 1.5;
  pen.stroke();
}

/// Path of a track with its number; dashed where its place is predicted.
function trail(pen, { id, trail_m: path, is_seen: isSeen }, place) {
  const places = path.map(([x, y]) => place(x, y));
  const [u, v] = places.at(-1);
  pen.strokeStyle = pen.fillStyle = colour("--track");
  pen.lineWidth = 2;
  pen.setLineDash(isSeen ? [] : [3, 3]);
  pen.beginPath();
  places.forEach(([a, b], index) => pen[index ? "lineTo" : "moveTo"](a, b));
  pen.stroke();
  pen.setLineDash([]);
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(String(id), u + 6, v + 14);
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
    const label = middle[1] - radius * view.zoom - 4;
    if (label > 12) pen.fillText(`${radius} m`, middle[0], label);
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

function outline(pen, box, place, shade, line, filled, dash = [], marked = false) {
  const [x, y] = box.center_m;
  const [cosine, sine] = [Math.cos(box.heading_rad), Math.sin(box.heading_rad)];
  const [length, width] = [box.size_m[0] / 2, box.size_m[1] / 2];
  const corner = (a, b) => place(x + a * length * cosine - b * width * sine, y + a * length * sine + b * width * cosine);
  pen.beginPath();
  [[1, 1], [1, -1], [-1, -1], [-1, 1]].forEach(([a, b], index) => pen[index ? "lineTo" : "moveTo"](...corner(a, b)));
  pen.closePath();
  // Heading: from the centre to the front.
  const [front, heart] = [corner(1, 0), corner(0.4, 0)];
  pen.moveTo(...heart);
  pen.lineTo(...front);
  pen.strokeStyle = shade;
  pen.lineWidth = marked ? line + 2.5 : line;
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

/// Estimated pose of a vehicle, the ellipse of its uncertainty, and a line to the true pose.
function vehicleMark(pen, vehicle, place) {
  const at = vehicle.pose || vehicle.truth;
  if (!at) return;
  const shade = ink(vehicle.cav);
  const [u, v] = place(at.x_m, at.y_m);
  const [a, b] = place(at.x_m + 3 * Math.cos(at.yaw_rad), at.y_m + 3 * Math.sin(at.yaw_rad));
  pen.strokeStyle = shade;
  pen.fillStyle = vehicle.pose ? shade : colour("--sheet");
  pen.lineWidth = view.chosen && view.chosen.cav === vehicle.cav ? 4 : 2;
  pen.beginPath();
  pen.moveTo(u, v);
  pen.lineTo(a, b);
  pen.stroke();
  pen.beginPath();
  pen.arc(u, v, 5, 0, 2 * Math.PI);
  pen.fill();
  pen.stroke();
  if (vehicle.pose && !view.hidden.has("sigma")) ellipse(pen, vehicle, at, place, shade);
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

/// 95 % of the position: 2.45 standard deviations along both axes of the covariance.
function ellipse(pen, vehicle, at, place, shade) {
  const round = sigma(vehicle);
  if (!isKnown(round)) return;
  const [xx, xy, yy] = vehicle.covariance_m2 || [round ** 2, 0, round ** 2];
  const [middle, apart] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
  const [long, short, turn] = [Math.sqrt(middle + apart), Math.sqrt(Math.max(0, middle - apart)), Math.atan2(2 * xy, xx - yy) / 2];
  pen.beginPath();
  for (let step = 0; step <= 36; step += 1) {
    const [c, s] = [2.45 * long * Math.cos(step * Math.PI / 18), 2.45 * short * Math.sin(step * Math.PI / 18)];
    pen[step ? "lineTo" : "moveTo"](...place(at.x_m + c * Math.cos(turn) - s * Math.sin(turn), at.y_m + c * Math.sin(turn) + s * Math.cos(turn)));
  }
  pen.strokeStyle = shade;
  pen.lineWidth = 1.5;
  pen.stroke();
}

// ---- selection ----

/// The box or vehicle at a position of the canvas.
function at(u, v) {
  const { frame } = view;
  if (!frame) return null;
  const world = unplace(u, v);
  const near = frame.vehicles.find((vehicle) => {
    const place = vehicle.pose || vehicle.truth;
    return place && Math.hypot(place.x_m - world[0], place.y_m - world[1]) * view.zoom < 14;
  });
  if (near) return { cav: near.cav };
  const inside = (box) => {
    const [dx, dy] = [world[0] - box.center_m[0], world[1] - box.center_m[1]];
    const [c, s] = [Math.cos(box.heading_rad), Math.sin(box.heading_rad)];
    return Math.abs(c * dx + s * dy) < box.size_m[0] / 2 + 0.3 && Math.abs(c * dy - s * dx) < box.size_m[1] / 2 + 0.3;
  };
  const result = results().of || frame;
  const box = result.detections.filter((found) => found.score >= view.score).find(inside);
  if (box) return { box };
  const object = result.truth.find(inside);
  return object ? { object: object.id } : null;
}

/// What is under the pointer, in a few words.
function described(what) {
  if (what.box) return `score ${number(what.box.score, 2)}`;
  if (what.cav) {
    const { confidence, ...vehicle } = view.frame.vehicles.find(({ cav }) => cav === what.cav);
    return isKnown(confidence) ? `${what.cav}: σ ${metres(sigma({ confidence, ...vehicle }))}` : what.cav;
  }
  const object = (results().of || view.frame).truth.find(({ id }) => id === what.object);
  const found = isKnown(object.found_score) ? `found with score ${number(object.found_score, 2)}` : "missed";
  return `${words(object.class)}: ${object.is_counted ? found : "not counted"}`;
}

/// Shows it beside the pointer; `null` hides it.
function tip(position) {
  const what = position && at(...position);
  $("tip").hidden = !what;
  if (!what) return;
  $("tip").textContent = described(what);
  const left = Math.min(position[0] + 14, canvas.clientWidth - $("tip").offsetWidth - 4);
  $("tip").style.left = `${left}px`;
  $("tip").style.top = `${Math.max(4, position[1] - 30)}px`;
}

/// World position of a position of the canvas: the inverse of `place` in `draw`.
function unplace(u, v) {
  const [cosine, sine] = [Math.cos(view.turn), Math.sin(view.turn)];
  const [a, b] = [(canvas.clientWidth / 2 + view.shift[0] - u) / view.zoom, (canvas.clientHeight * 0.55 + view.shift[1] - v) / view.zoom];
  // a = cosine * dy - sine * dx, b = cosine * dx + sine * dy
  return [view.centre[0] + cosine * b - sine * a, view.centre[1] + cosine * a + sine * b];
}

// ---- navigation ----

let pressed = null;
const inCanvas = (event) => {
  const { left, top } = canvas.getBoundingClientRect();
  return [event.clientX - left, event.clientY - top];
};

const fingers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  pressed = fingers.size === 1 ? [event.clientX, event.clientY] : null;
});
canvas.addEventListener("pointerup", (event) => {
  const isClick = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 5;
  if (!isClick) return;
  choose(at(...inCanvas(event)));
});
canvas.addEventListener("pointerleave", () => tip(null));
canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  // A finger has no place where it does not press.
  tip(before || event.pointerType === "touch" ? null : inCanvas(event));
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
