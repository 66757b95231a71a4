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
  // Heading: from the centre to the front.
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

/// Estimated pose of a vehicle, a ring for its confidence, and a line to the true pose.
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

// ---- navigation ----

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
