"use strict";
// Links over time: rate, time on the link and bytes that wait.

/// Longest time that is kept of a live run, seconds.
const KEPT = 60;
/// Of a live run: one entry per frame with a result, as in the timeline of a recorded one.
let kept = [];

/// Keeps the links of a frame of a live run.
function keepLinks(frame) {
  if (tape.timeline.length || !frame.ego) return;
  const last = kept[kept.length - 1];
  // Another replay, or another ego.
  if (last && last.capture_s >= frame.capture_s) kept = [];
  const links = frame.links.map((link) => ({ from: link.from, sent_bytes: link.wire_bytes, transit_ms: link.latency_ms, waiting_bytes: null }));
  kept.push({ capture_s: frame.capture_s, tick: frame.tick, links });
  kept = kept.filter((entry) => entry.capture_s > frame.capture_s - KEPT);
}

/// Time from one tick to the next, seconds: the median, which a pause in the recording does not change.
function period(entries) {
  const steps = entries.slice(1).map((entry, index) => {
    const before = entries[index];
    const ticks = isKnown(entry.tick) && isKnown(before.tick) ? entry.tick - before.tick : 1;
    return ticks > 0 ? (entry.capture_s - before.capture_s) / ticks : 0;
  }).filter((step) => step > 0).sort((a, b) => a - b);
  const [low, high] = [steps[(steps.length - 1) >> 1], steps[steps.length >> 1]];
  return steps.length ? (low + high) / 2 : null;
}

/// The three strips: name, unit, value of a link.
function strips(entries) {
  const tick = period(entries);
  const rate = (link) => (tick && isKnown(link.sent_bytes) ? 8e-6 * link.sent_bytes / tick : null);
  return [
    ["rate", (value) => `${number(value, value < 10 ? 2 : 1)} Mbit/s`, rate],
    ["time on the link", ms, (link) => link.transit_ms],
    ["waiting", bytes, (link) => link.waiting_bytes],
  ].filter(([, , of]) => entries.some(({ links }) => links.some((link) => isKnown(of(link)))));
}

function series() {
  const entries = tape.timeline.length ? tape.timeline : kept;
  const known = entries.length > 1 ? strips(entries) : [];
  $("seriesbox").hidden = !known.length;
  if (!known.length) return;
  const now = entries[tape.timeline.length ? Math.max(0, tape.at) : entries.length - 1];
  // Rates and bytes of all links together, the longest time.
  const figures = known.map(([name, written, of]) => {
    const values = now.links.map(of).filter(isKnown);
    if (!values.length) return null;
    const value = name === "time on the link" ? Math.max(...values) : values.reduce((sum, one) => sum + one, 0);
    return name === "rate" ? written(value) : name === "waiting" ? `${written(value)} waiting` : `${written(value)} on the link`;
  });
  $("serieshead").textContent = figures.filter(Boolean).join(", ") || "nothing sent at this tick";
  chart(entries, known, now);
}

function chart(entries, known, now) {
  const canvas = $("series");
  const [scale, width, height] = [devicePixelRatio || 1, canvas.clientWidth, 150];
  if (!width) return;
  [canvas.width, canvas.height] = [width * scale, height * scale];
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.font = "11px system-ui, sans-serif";
  const [begin, end] = [entries[0].capture_s, entries[entries.length - 1].capture_s];
  const x = (seconds) => 1 + (width - 2) * (seconds - begin) / Math.max(1e-3, end - begin);
  const froms = [...new Set(entries.flatMap(({ links }) => links.map(({ from }) => from)))];
  const strip = height / known.length;
  known.forEach(([name, written, of], index) => {
    const [top, bottom] = [index * strip + 15, (index + 1) * strip - 3];
    const most = entries.reduce((max, { links }) => links.reduce((so, link) => Math.max(so, of(link) ?? 0), max), 0);
    pen.fillStyle = colour("--faint");
    pen.fillText(most > 0 ? `${name}, up to ${written(most)}` : `${name}: none`, 0, top - 4);
    pen.fillStyle = colour("--grid");
    pen.fillRect(0, bottom, width, 1);
    for (const from of froms) {
      pen.strokeStyle = ink(from);
      pen.lineWidth = 2;
      pen.lineCap = "round";
      pen.beginPath();
      let isDown = false;
      for (const entry of entries) {
        const link = entry.links.find((known) => known.from === from);
        const value = link ? of(link) : null;
        // A gap where nothing is known.
        if (!isKnown(value)) { isDown = false; continue; }
        const at = [x(entry.capture_s), bottom - (bottom - top) * value / (most || 1)];
        // A line to the same place is a dot, for a value between two gaps.
        if (!isDown) pen.moveTo(...at);
        pen.lineTo(...at);
        isDown = true;
      }
      pen.stroke();
    }
  });
  if (!tape.timeline.length) return;
  pen.fillStyle = colour("--ink");
  pen.fillRect(x(now.capture_s) - 0.5, 0, 1, height);
}

/// A click goes to the moment.
$("series").addEventListener("click", (event) => {
  if (!tape.timeline.length) return;
  const share = event.offsetX / Math.max(1, $("series").clientWidth);
  play(false);
  seek(Math.round(share * (tape.timeline.length - 1)));
});
