"use strict";
// Fetches scene frames from the server, shows the newest, and keeps no others.

function state(mode, text) {
  root.dataset.mode = mode;
  $("state").textContent = text;
}

function hint(text) {
  $("hint").textContent = text;
  $("hint").hidden = false;
}

/// Live: frames as they arrive, each after its length; the server keeps only the newest for each page.
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
    // An error in here is one of the page, and not the end of the run.
    try { if (newest) show(newest.buffer); } catch (error) { fail(String(error)); }
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

/// Recorded: one frame at a time; during a fetch only the last request counts.
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

/// Latency over the run; gaps are frames without detections.
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
