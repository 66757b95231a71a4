"use strict";
// Feature map of one vehicle in the scene: the mean of the absolute values of its channels, cell by cell.

/// The map that is drawn, and that which was asked for last.
const heat = { cav: null, capture_s: 0, grid: null, image: null, source: null, isBusy: false, isMissing: false };
/// Opacity of the brightest cell.
const BRIGHTEST = 0.85;
/// Largest age of a map of a live run that is drawn, seconds.
const OLDEST_MAP = 0.35;

/// Fetches the map of the selected vehicle, or of the ego, if it is to be shown; one at a time.
async function fetchHeat(frame) {
  const cav = focused(frame);
  if (view.hidden.has("map") || !cav) return;
  const source = `map/${cav}${tape.timeline.length ? `?at=${tape.at}` : `?t=${frame.capture_s}`}`;
  if (heat.isBusy || heat.source === source) return;
  heat.isBusy = true;
  heat.source = source;
  try {
    const answer = await fetch(source);
    if (answer.ok) takeHeat(cav, await answer.arrayBuffer());
  } finally {
    heat.isBusy = false;
  }
  legend(view.frame);
  draw();
  // What was selected meanwhile.
  if (tape.timeline.length) fetchHeat(view.frame);
}

/// A JSON document after its length, then one byte per cell, row by row; empty: the vehicle publishes none.
function takeHeat(cav, buffer) {
  heat.isMissing = buffer.byteLength === 0;
  heat.image = null;
  if (heat.isMissing) return;
  const length = new DataView(buffer).getUint32(0, true);
  const { capture_s: captured, grid } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const levels = new Uint8Array(buffer, 4 + length);
  const image = document.createElement("canvas");
  [image.width, image.height] = [grid.width, grid.height];
  const pen = image.getContext("2d");
  const pixels = pen.createImageData(grid.width, grid.height);
  const shade = [1, 3, 5].map((place) => parseInt(ink(cav).slice(place, place + 2), 16));
  levels.forEach((level, cell) => pixels.data.set([...shade, BRIGHTEST * level], 4 * cell));
  pen.putImageData(pixels, 0, 0);
  Object.assign(heat, { cav, capture_s: captured, grid, image });
}

/// Draws it in the LiDAR frame of its vehicle.
function drawHeat(pen, frame, place, scale) {
  const vehicle = frame.vehicles.find(({ cav }) => cav === heat.cav);
  const isOld = Math.abs(heat.capture_s - frame.capture_s) > (tape.timeline.length ? 0 : OLDEST_MAP);
  if (view.hidden.has("map") || !heat.image || !vehicle || !vehicle.world_from_lidar || isOld) return;
  const { x_min_m: x, y_min_m: y, cell_m: cell } = heat.grid;
  const corner = (column, row) => place(...placed(vehicle.world_from_lidar, x + column * cell, y + row * cell));
  const [origin, right, up] = [corner(0, 0), corner(1, 0), corner(0, 1)];
  pen.save();
  pen.setTransform(scale * (right[0] - origin[0]), scale * (right[1] - origin[1]),
    scale * (up[0] - origin[0]), scale * (up[1] - origin[1]), scale * origin[0], scale * origin[1]);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(heat.image, 0, 0);
  pen.restore();
}
