"use strict";
// Probe of the page of `v2vloc view` and of a sweep's report: loaded before their scripts by page_checks.py, returns plain
// values. Keeps what is drawn on the scene: paths with their colour, and texts.

const probe = { drawn: [], lines: {} };

for (const [name, style] of [["stroke", "strokeStyle"], ["fill", "fillStyle"], ["fillText", "fillStyle"]]) {
  const original = CanvasRenderingContext2D.prototype[name];
  CanvasRenderingContext2D.prototype[name] = function (...given) {
    if (name === "stroke" && this.canvas.id) probe.lines[this.canvas.id] = (probe.lines[this.canvas.id] || 0) + 1;
    if (this.canvas.id === "scene") probe.drawn.push({ name, colour: this[style], path: [...(this.path || [])] });
    return original.apply(this, given);
  };
}
for (const name of ["beginPath", "moveTo", "lineTo", "arc"]) {
  const original = CanvasRenderingContext2D.prototype[name];
  CanvasRenderingContext2D.prototype[name] = function (...given) {
    if (name === "beginPath") this.path = []; else (this.path ||= []).push(given);
    return original.apply(this, given);
  };
}

/// What one drawing of the scene consists of.
probe.scene = () => {
  probe.drawn.length = 0;
  draw();
  return probe.drawn;
};

/// Number of feature maps in one drawing of the scene.
probe.pictures = 0;
const drawImage = CanvasRenderingContext2D.prototype.drawImage;
CanvasRenderingContext2D.prototype.drawImage = function (...given) {
  probe.pictures += 1;
  return drawImage.apply(this, given);
};
probe.maps = () => {
  probe.pictures = 0;
  draw();
  return probe.pictures;
};

/// Number of lines that one drawing of a chart consists of.
probe.strokes = (id) => {
  probe.lines[id] = 0;
  series();
  return probe.lines[id];
};

/// Switches a layer of the legend.
probe.layer = (name) => [...document.querySelectorAll("#legend label")].find((label) => label.textContent.includes(name)).querySelector("input").click();

/// Chooses an entry of a list, as a person does.
probe.select = (selector, value) => {
  const list = document.querySelector(selector);
  list.value = value;
  list.dispatchEvent(new Event("change"));
};

/// A colour, or a property of the style sheet that holds one, as the canvas spells it.
probe.spelt = (colour) => {
  const pen = document.createElement("canvas").getContext("2d");
  const property = /--\w+/.exec(colour);
  pen.fillStyle = property ? getComputedStyle(document.documentElement).getPropertyValue(property[0]).trim() : colour;
  return pen.fillStyle;
};

/// Number of colours of the scene's pixels.
probe.colours = () => {
  const canvas = document.getElementById("scene");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return new Set(new Uint32Array(data.buffer)).size;
};

/// Colours of strokes and fills of the scene without an entry in the legend; rings and the sheet need none.
probe.unexplained = () => {
  const entries = [...document.querySelectorAll("#legend label")].map((label) => probe.spelt(label.style.getPropertyValue("--swatch")));
  const known = new Set([...entries, probe.spelt("--grid"), probe.spelt("--sheet")]);
  return [...new Set(probe.scene().filter(({ name }) => name !== "fillText").map(({ colour }) => colour))].filter((colour) => !known.has(colour));
};

/// Outlines of detections, right or wrong.
probe.detections = () => {
  const colours = [probe.spelt("--hit"), probe.spelt("--wrong")];
  // Four corners, and the heading.
  return probe.scene().filter(({ name, colour, path }) => name === "stroke" && path.length === 6 && colours.includes(colour));
};

/// Paths and numbers of tracks: points of each path, and the texts.
probe.tracks = () => {
  const drawn = probe.scene().filter(({ colour }) => colour === probe.spelt("--track"));
  const paths = drawn.filter(({ name }) => name === "stroke").map(({ path }) => path.length);
  return { paths, numbers: drawn.filter(({ name }) => name === "fillText").length };
};

/// Marks of vehicles.
probe.marks = () => probe.scene().filter(({ name, path }) => name === "stroke" && path.length === 1 && path[0][2] === 5);

/// Places in the window of what was drawn, where nothing covers it, the furthest from the middle first.
probe.places = (strokes) => {
  const canvas = document.getElementById("scene");
  const { left, top, width, height } = canvas.getBoundingClientRect();
  const mean = (corners, axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length;
  const distance = ([x, y]) => Math.abs(x - left - width / 2) + Math.abs(y - top - height / 2);
  const places = strokes.map(({ path }) => [left + mean(path.slice(0, 4), 0), top + mean(path.slice(0, 4), 1)]);
  const isFree = ([x, y]) => [-8, 8].every((by) => document.elementFromPoint(x + by, y + by) === canvas);
  return places.filter(isFree).sort((a, b) => distance(b) - distance(a));
};

probe.visible = (selector) => [...document.querySelectorAll(selector)].filter((node) => node.checkVisibility());
probe.label = (node) => node.id || node.textContent.trim().slice(0, 30);

/// Texts with less than the contrast of 4.5 that WCAG 2 asks for.
probe.faint = () => {
  const channels = (colour) => colour.match(/[\d.]+/g).map(Number);
  const linear = (c) => (c / 255 <= 0.03928 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4);
  const luminance = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const behind = (node) => {
    if (!node) return [255, 255, 255];
    const colour = channels(getComputedStyle(node).backgroundColor);
    return colour.length < 4 || colour[3] > 0 ? colour : behind(node.parentElement);
  };
  const contrast = (node) => {
    const [a, b] = [luminance(channels(getComputedStyle(node).color)), luminance(behind(node))];
    return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
  };
  const hasText = (node) => [...node.childNodes].some((child) => child.nodeType === Node.TEXT_NODE && child.textContent.trim());
  return probe.visible("body *").filter((node) => hasText(node) && contrast(node) < 4.5).map((node) => `${probe.label(node)}: ${contrast(node).toFixed(1)}`);
};

/// Texts that are cut, or reach out of the window, other than in parts that scroll.
probe.cut = () => {
  const nodes = probe.visible("body *").filter((node) => !node.closest("canvas, svg, input, select, .wide, pre") && node.textContent.trim());
  return nodes.flatMap((node) => {
    const { left, right } = node.getBoundingClientRect();
    if (right > innerWidth + 1 || left < -1) return [`${probe.label(node)} from ${left} to ${right} of ${innerWidth}`];
    const isCut = node.clientWidth && node.scrollWidth > node.clientWidth + 1;
    return isCut ? [`${probe.label(node)}: ${node.scrollWidth} in ${node.clientWidth}`] : [];
  });
};

/// Controls and notes over the scene that cover each other.
probe.overlaps = () => {
  const boxes = probe.visible(".tools, .legend, .card, .banner, .hint").map((node) => [node.className, node.getBoundingClientRect()]);
  const isOver = (p, q) => p.left < q.right && q.left < p.right && p.top < q.bottom && q.top < p.bottom;
  return boxes.flatMap(([a, p], index) => boxes.slice(index + 1).filter(([, q]) => isOver(p, q)).map(([b]) => `${a} and ${b}`));
};

/// Words for a status of the server.
probe.stateOf = async (status) => {
  const real = window.fetch;
  window.fetch = async () => new Response(JSON.stringify(status));
  try { await check(); } finally { window.fetch = real; }
  return document.getElementById("state").textContent;
};

/// Sets the slider of the score, and leaves it.
probe.setScore = (score) => {
  const slider = document.getElementById("score");
  slider.value = score;
  slider.dispatchEvent(new Event("input"));
  slider.blur();
};

/// Widths of the images of the cameras, pixels.
probe.images = () => [...document.querySelectorAll("#images img")].map((image) => image.naturalWidth);

/// Heads of a table, each with the texts of its column.
probe.columns = () => [...document.querySelectorAll("thead th")].map((head, at) =>
  [head.textContent, [...document.querySelectorAll("tbody tr")].map((row) => row.children[at].textContent)]);
