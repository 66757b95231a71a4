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

/// Address of data of the chosen ego.
const ofEgo = (path) => (view.ego ? `${path}?ego=${view.ego}` : path);

/// Live: frames as they arrive, each after its length; the server keeps only the newest for each page.
let stream = new AbortController();
async function live() {
  stream = new AbortController();
  const answer = await fetch(ofEgo("live"), { signal: stream.signal });
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
    try { if (newest) show(parse(newest.buffer)); } catch (error) { fail(String(error)); }
  }
}

async function watch() {
  setInterval(check, 1000);
  for (;;) {
    await live().catch(() => {});
    // Another ego was chosen.
    if (stream.signal.aborted) continue;
    state("ended", "v2vloc view is gone; trying again");
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}

/// What processes report, and outages of the router: they stay when results come again.
function problems(texts) {
  $("problembox").hidden = !texts.length;
  $("problems").replaceChildren(...texts.map((text) => element("li", {}, text)));
}

/// State of the live run: going on, over, or out of reach.
async function check() {
  const answer = await fetch("status").catch(() => null);
  if (!answer || !answer.ok) return;
  const status = await answer.json();
  const { silent_s: silent, is_over: over, has_router: router, images_left_out: leftOut } = status;
  view.imagesLeftOut = leftOut;
  problems([...status.problems || [], ...status.router_outages ? [`observed: ${status.router_outages}`] : []]);
  const before = isKnown(silent) ? ` ${seconds(silent)} ago` : "";
  if (over && silent > 2) state("over", `ended${before}${router ? "" : ", router gone"}`);
  else if (!router) state("ended", before ? `router gone, last message${before}` : "router gone");
  else if (!isKnown(silent)) state("waiting", "waiting for the run");
  else if (silent > 3) state("ended", `last message${before}`);
  else if (status.unanswered_s > 3) state("ended", status.problems[0] || `no result for ${seconds(status.unanswered_s)}`);
  else state("live", "live");
  if (!isKnown(silent)) hint("Nothing is published in this run yet.");
}

const tape = { timeline: [], egos: [], at: -1, wanted: 0, busy: false, playing: null };

async function moment(index) {
  const answer = await fetch(ofEgo(`frame/${index}`));
  if (!answer.ok) throw new Error(await answer.text());
  return parse(await answer.arrayBuffer());
}

/// The last result until a moment, which is shown where there is none: the same on every way to it.
async function resultUntil(index) {
  const isAnswered = (at) => tape.timeline[at].latency_ms !== null;
  if (isAnswered(index)) return;
  let at = index - 1;
  while (at >= 0 && !isAnswered(at)) at -= 1;
  const known = view.answered && view.answered.capture_s;
  if (at < 0) view.answered = null;
  else if (known !== tape.timeline[at].capture_s) view.answered = (await moment(at)).frame;
}

/// A link to the moment in the address; not during play, as browsers limit how often that may change.
function link() {
  if (!tape.playing && tape.at >= 0) history.replaceState(null, "", `#at=${tape.at}${view.ego ? `&ego=${view.ego}` : ""}`);
}

/// Recorded: one frame at a time; during a fetch only the last request counts.
async function seek(index) {
  tape.wanted = Math.min(tape.timeline.length - 1, Math.max(0, index));
  $("seek").value = String(tape.wanted);
  if (tape.busy) return;
  tape.busy = true;
  try {
    while (tape.at !== tape.wanted) {
      const next = tape.wanted;
      const found = await moment(next);
      await resultUntil(next);
      tape.at = next;
      $("moment").textContent = `${next + 1} of ${tape.timeline.length}`;
      show(found);
      link();
      spark();
    }
  } finally {
    tape.busy = false;
  }
}

function play(on) {
  clearInterval(tape.playing);
  const last = tape.timeline.length - 1;
  // At the end it starts again.
  if (on && tape.wanted >= last) seek(0);
  tape.playing = on ? setInterval(() => {
    if (tape.wanted >= last) play(false); else seek(tape.wanted + 1);
  }, 100 / Number($("speed").value)) : null;
  $("play").textContent = on ? "pause" : "play";
  link();
}

/// The frame with the most false positives and missed objects.
function worst() {
  const wrong = (moment) => (moment.judged ? moment.judged[1] + moment.judged[2] : -1);
  return tape.timeline.reduce((most, moment, index) => (wrong(moment) > wrong(tape.timeline[most]) ? index : most), 0);
}

/// Latency over the run; marks below the line are ticks without a result.
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
  const gaps = times.filter((time) => time === null).length;
  pen.fillText(`latency, up to ${ms(most)}${gaps ? `; red: ${gaps} ticks without a result` : ""}`, 8, 10);
  const bar = Math.max(1, Math.min(10, (width - 16) / times.length - 1));
  times.forEach((time, index) => {
    pen.fillStyle = time === null ? colour("--bad") : colour("--ink");
    pen.globalAlpha = index === tape.at ? 1 : 0.35;
    const top = time === null ? height - 7 : y(time);
    pen.fillRect(x(index) - bar / 2, top, bar, height - 4 - top);
  });
  pen.globalAlpha = 1;
}

/// Moment that an address names (`#at=N`).
function asked(address) {
  const at = /[#?&]at=(\d+)/.exec(address);
  return at ? Number(at[1]) : 0;
}

/// Ego that an address names (`&ego=CAV`).
function askedEgo(address) {
  const ego = /[#?&]ego=([a-z0-9_-]+)/.exec(address);
  return ego ? ego[1] : null;
}

/// Shows the results of another ego.
async function chooseEgo(ego) {
  view.ego = ego;
  view.answered = null;
  kept = [];
  if (!tape.timeline.length) return stream.abort();
  tape.timeline = (await (await fetch(ofEgo("run"))).json()).timeline;
  tape.at = -1;
  await seek(tape.wanted);
}
$("ego").addEventListener("change", () => chooseEgo($("ego").value));

async function begin() {
  view.ego = askedEgo(location.href);
  const run = await (await fetch(ofEgo("run"))).json();
  $("run").textContent = run.run;
  document.title = `${run.run} · v2vloc`;
  view.cameras = run.cameras || [];
  tape.egos = run.egos || [];
  // A link to an ego without results shows the first one.
  if (run.mode === "recorded" && !tape.egos.includes(view.ego)) view.ego = null;
  if (run.mode === "live") return watch();
  tape.timeline = run.timeline;
  $("timeline").hidden = false;
  $("seek").max = String(run.timeline.length - 1);
  $("seek").addEventListener("input", () => { play(false); seek(Number($("seek").value)); });
  $("play").addEventListener("click", () => play(!tape.playing));
  $("speed").addEventListener("change", () => { if (tape.playing) play(true); });
  $("back").addEventListener("click", () => { play(false); seek(tape.wanted - 1); });
  $("ahead").addEventListener("click", () => { play(false); seek(tape.wanted + 1); });
  $("worst").addEventListener("click", () => { play(false); seek(worst()); });
  addEventListener("keydown", (event) => {
    const { id, tagName } = event.target;
    if (["SELECT", "INPUT"].includes(tagName) && id !== "seek") return;
    // A button is pressed by space itself.
    if (event.key === " " && !["BUTTON", "SUMMARY"].includes(tagName)) { event.preventDefault(); play(!tape.playing); }
    if (event.key === "ArrowRight") { event.preventDefault(); play(false); seek(tape.wanted + 1); }
    if (event.key === "ArrowLeft") { event.preventDefault(); play(false); seek(tape.wanted - 1); }
  });
  addEventListener("hashchange", async (event) => {
    const ego = askedEgo(event.newURL);
    if (ego !== view.ego && (!ego || tape.egos.includes(ego))) await chooseEgo(ego);
    await seek(asked(event.newURL));
  });
  state("recorded", "recorded");
  await seek(asked(location.href));
}

addEventListener("resize", () => { draw(); series(); spark(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { draw(); series(); spark(); });

begin().catch((error) => { fail(String(error)); state("ended", "no answer from v2vloc view"); });
