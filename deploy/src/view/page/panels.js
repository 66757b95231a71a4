"use strict";
// Panels beside the scene: figures of the frame, vehicles, links, stages, messages, legend.

function facts(frame) {
  $("time").textContent = `${number(frame.capture_s, 1)} s`;
  const method = frame.method || (view.answered && view.answered.method) || "–";
  // Of a TorchScript file the name, without its folder.
  $("method").textContent = method.replace(/^script:.*\//, "script:");
  $("method").title = method;
  $("latency").textContent = ms(frame.latency_ms);
  const { answered, ticks, rate_hz: rate } = frame.pace;
  const share = ticks ? ` (${number(100 * answered / ticks, 0)} %)` : "";
  $("answered").textContent = `${answered}/${ticks}${share}${rate === null ? "" : `, ${number(rate, 1)} Hz`}`;
  const counts = judged();
  $("judged").textContent = counts ? `${counts.hits} / ${counts.wrong} / ${counts.missed}` : "–";
  $("precision").title = `Objects that count: protocol ${frame.protocol}`;
  $("precision").textContent = isKnown(frame.ap_50) ? number(100 * frame.ap_50, 1) + " %" : "–";
  const { of, age } = results();
  const skipped = !frame.ego;
  $("banner").hidden = !skipped;
  if (skipped) {
    $("banner").textContent = of
      ? `No result at this tick: the ego leaves it out. Shown is the result from ${number(age, 1)} s before.`
      : "No result at this tick yet.";
  }
}

function panels(frame) {
  const last = view.answered || frame;
  $("vehicles").replaceChildren(...frame.vehicles.map((vehicle) => vehicleCard(vehicle, last.ego)));
  egos(frame.egos);
  legend(frame);
  cameras(frame);
  card();
  const hasTrust = last.links.some((link) => isKnown(link.trust));
  table("links", [["from"], ["latency", "From publication to arrival at the ego"], ["size", "Bytes of all its messages for this frame"],
    ["age", "Capture of the ego's sweep minus that of the neighbour's"], ["clock", "Offset of the neighbour's clock from the ego's, as estimated"],
    ["capture", "Offset of the neighbour's capture times from the ego's, which the ego corrects"],
    ...(hasTrust ? [["trust", "Trust score of misbehaviour detection"]] : []), [""]],
  last.links.map((link) => [
    link.from, ms(link.latency_ms), bytes(link.wire_bytes), ms(link.age_ms), ms(link.clock_ms), ms(link.capture_ms), ...(hasTrust ? [number(link.trust, 2)] : []),
    link.is_fused ? "fused" : [[link.skipped || "silent", link.misbehaviour].filter(Boolean).map(words).join(": "), "bad"],
  ]), last.ego ? "No neighbour sends to the ego." : "No result yet.");
  stages(last);
  messages(frame.messages);
  processes(frame.processes);
}

/// Choice of the ego, where there are several.
function egos(all) {
  $("egobox").hidden = all.length < 2;
  const shown = view.ego || (view.answered && view.answered.ego);
  if ($("ego").children.length !== all.length) {
    $("ego").replaceChildren(...all.map((cav) => element("option", { value: cav }, cav)));
  }
  if (shown && document.activeElement !== $("ego")) $("ego").value = shown;
}

/// The selected vehicle, or the ego.
const focused = (frame) => (view.chosen && view.chosen.cav) || (view.answered && view.answered.ego) || (frame.vehicles[0] && frame.vehicles[0].cav);

/// Standard deviation of a position along its longest axis, metres: of the covariance, or as Eq. 6 maps the confidence.
function sigma(vehicle) {
  if (vehicle.covariance_m2) {
    const [xx, xy, yy] = vehicle.covariance_m2;
    return Math.sqrt((xx + yy) / 2 + Math.hypot((xx - yy) / 2, xy));
  }
  return vehicle.confidence > 0 ? Math.sqrt(1 / vehicle.confidence - 1) : null;
}

function vehicleCard(vehicle, egoCav) {
  const isEgo = vehicle.cav === egoCav;
  // Without a message it has left out the tick, and only a refusal is "no pose".
  let status = "tick left out";
  if (isKnown(vehicle.confidence)) status = `σ ${metres(sigma(vehicle))}`;
  else if (vehicle.no_pose) status = `no pose: ${words(vehicle.no_pose)}`;
  const error = isKnown(vehicle.error_m) ? `, ${metres(vehicle.error_m)} off` : "";
  const isChosen = view.chosen && view.chosen.cav === vehicle.cav;
  return element("button", {
    class: "vehicle", type: "button", swatch: swatch(vehicle.cav), "aria-pressed": String(Boolean(isChosen)),
    title: "Select this vehicle", click: () => choose(isChosen ? null : { cav: vehicle.cav }),
  }, element("b", {}, vehicle.cav + (isEgo ? " (ego)" : "")), element("small", {}, status + error));
}

/// What was selected, in words.
function card() {
  const { frame, chosen } = view;
  const rows = [];
  let title = "";
  if (chosen && chosen.cav) {
    const vehicle = frame.vehicles.find((known) => known.cav === chosen.cav);
    title = `Vehicle ${chosen.cav}`;
    if (vehicle) {
      rows.push(["confidence", number(vehicle.confidence, 3)], ["σ of the position", isKnown(vehicle.confidence) ? metres(sigma(vehicle)) : "–"],
        ["error", metres(vehicle.error_m)]);
      const at = vehicle.pose || vehicle.truth;
      if (at) rows.push([vehicle.pose ? "pose" : "true pose", `${number(at.x_m, 1)}, ${number(at.y_m, 1)} m, ${number(at.yaw_rad * 180 / Math.PI, 1)}°`]);
      if (vehicle.no_pose) rows.push(["no pose", words(vehicle.no_pose)]);
    }
  } else if (chosen && isKnown(chosen.object)) {
    const { of } = results();
    const object = ((of || frame).truth).find((known) => known.id === chosen.object);
    title = `Object ${chosen.object}`;
    if (object) {
      rows.push(["class", words(object.class)], ["size", object.size_m.map((edge) => number(edge, 1)).join(" × ") + " m"],
        ["speed", isKnown(object.speed_mps) ? `${number(object.speed_mps, 1)} m/s` : "–"],
        ["detected", !object.is_counted ? "outside the area or out of range" : isKnown(object.found_score) ? `score ${number(object.found_score, 2)}` : "no"]);
    }
  } else if (chosen && chosen.box) {
    const { box } = chosen;
    title = "Detection";
    rows.push(["score", number(box.score, 2)], ["size", box.size_m.map((edge) => number(edge, 1)).join(" × ") + " m"],
      ["matches an object", isKnown(box.is_hit) ? (box.is_hit ? "yes" : "no") : "–"], ["seen by", box.source || "all together"]);
  }
  $("card").hidden = !title;
  if (!title) return;
  $("card").replaceChildren(
    element("header", {}, element("b", {}, title), element("button", { type: "button", title: "Close", click: () => choose(null) }, "×")),
    element("dl", {}, ...rows.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)])));
}

function choose(what) {
  view.chosen = what;
  // On a phone there is room for one of the two.
  if (what && isPhone.matches) $("legendbox").open = false;
  refresh();
}

/// Images of the selected vehicle, or of the ego. The cameras of a live run are those of its message counters.
function cameras(frame) {
  if (!tape.timeline.length) {
    const numbers = frame.messages.flatMap(({ topic }) => /\/camera\/(\d+)$/.exec(topic)?.[1] ?? []);
    view.cameras = [...new Set(numbers)].sort();
  }
  const chosen = focused(frame);
  $("cameras").hidden = !view.cameras.length || !chosen;
  if ($("cameras").hidden) return;
  $("cameracav").textContent = chosen;
  $("imagesleftout").hidden = !view.imagesLeftOut;
  $("imagesleftout").textContent = `images of ${view.imagesLeftOut} more cameras of this run are not shown`;
  const at = tape.timeline.length ? `?at=${tape.wanted}` : `?t=${frame.capture_s}`;
  view.cameras.forEach((camera, place) => {
    let image = $("images").children[place];
    if (!image) {
      image = element("img", { alt: `camera ${camera}`, title: `camera ${camera}` });
      $("images").append(image);
    }
    const source = `camera/${chosen}/${camera}${at}`;
    // One request at a time for each camera: a slow connection shows fewer images, not later ones.
    if (image.dataset.wanted !== source && image.complete) {
      image.dataset.wanted = source;
      image.src = source;
    }
  });
}

// ---- tables ----

/// Row of a topic: the counters of its sender, and the losses at its receivers.
function messages(counted) {
  const topics = new Map();
  for (const { topic, to, sent, received, dropped } of counted) {
    const line = topics.get(topic) || { sent: 0, used: 0, receivers: 0, dropped: 0, reasons: new Set() };
    topics.set(topic, line);
    line.sent += sent;
    if (to !== null) { line.used += received; line.receivers += 1; }
    for (const [reason, count] of Object.entries(dropped)) if (count > 0) { line.dropped += count; line.reasons.add(words(reason)); }
  }
  const rows = [...topics].filter(([, line]) => line.sent + line.used + line.dropped > 0);
  const [used, dropped] = rows.reduce(([a, b], [, line]) => [a + line.used, b + line.dropped], [0, 0]);
  const all = used + dropped;
  const most = rows.reduce((worst, row) => (row[1].dropped > (worst ? worst[1].dropped : 0) ? row : worst), null);
  // A share says something of many only; of one topic there may be few.
  const share = all < 100 ? `${dropped} of ${all}` : `${number(100 * dropped / all, 1)} % of ${all}`;
  const ofMost = most && `most of ${most[0]}: ${most[1].dropped} of ${most[1].used + most[1].dropped}, ${[...most[1].reasons].join(", ")}`;
  $("messagehead").textContent = all ? `${share} not used${most ? `; ${ofMost}` : ""}` : "nothing counted yet";
  table("messages", [["topic"], ["sent", "Published"], ["used", "Used by receivers"], ["not used", "Left out or lost, by reason"]],
    rows.map(([topic, line]) => [
      topic, line.sent, line.receivers > 1 ? `${line.used} by ${line.receivers}` : line.used,
      line.dropped ? [`${line.dropped} ${[...line.reasons].join(", ")}`, "bad"] : 0,
    ]), "Nothing counted yet.");
}

function processes(all) {
  const rows = all.flatMap((process) => process.stages.map((stage) => [`${process.process} · ${stage.stage}`, stage.p50_ms, stage.p95_ms]));
  const slowest = rows.reduce((worst, row) => (!worst || row[2] > worst[2] ? row : worst), null);
  $("processhead").textContent = slowest ? `slowest: ${slowest[0]}, 95th percentile ${ms(slowest[2])}` : "no process has reported yet";
  table("processes", [["stage"], ["p50", "Median"], ["p95", "95th percentile"]], rows.map(([name, p50, p95]) => [name, ms(p50), ms(p95)]), "No process has reported yet.");
}

function table(id, heads, rows, empty) {
  if (!rows.length) return $(id).replaceChildren(element("caption", { class: "empty" }, empty));
  const cell = (value) => (Array.isArray(value) ? element("td", { class: value[1] }, value[0]) : element("td", {}, String(value)));
  $(id).replaceChildren(
    element("thead", {}, element("tr", {}, ...heads.map(([head, title]) => element("th", title ? { title } : {}, head)))),
    element("tbody", {}, ...rows.map((row) => element("tr", {}, ...row.map(cell)))));
}

/// Time from capture to detections: the stages of the ego, and before them those of its agent.
function stages(frame) {
  const timings = frame.stages.map(({ stage, nanos }) => [stage, nanos / 1e6]);
  const rest = isKnown(frame.latency_ms) ? frame.latency_ms - timings.reduce((sum, [, time]) => sum + time, 0) : null;
  const posed = isKnown(frame.posed_ms);
  const marks = [["sweep", frame.swept_ms], [isKnown(frame.swept_ms) ? "pose" : "sweep and pose", frame.posed_ms], [posed ? "map" : "agent", rest]];
  let before = 0;
  const agent = marks.flatMap(([stage, until]) => {
    if (!isKnown(until) || until <= before) return [];
    const time = until - before;
    before = until;
    return [[stage, time]];
  });
  const parts = agent.concat(timings).filter(([, time]) => time >= 0.05);
  if (!parts.length) {
    $("stagehead").textContent = "";
    return $("stages").replaceChildren(element("p", { class: "empty" }, "No detections yet."));
  }
  const sum = parts.reduce((total, [, time]) => total + time, 0);
  const slowest = parts.reduce((worst, part) => (part[1] > worst[1] ? part : worst));
  $("stagehead").textContent = `${ms(sum)}, most of it ${slowest[0]} (${number(100 * slowest[1] / sum, 0)} %)`;
  // One ramp from light to dark: stages have no colours of their own, vehicles do.
  const shade = (index) => `color-mix(in srgb, var(--ink) ${Math.round(20 + 65 * index / Math.max(1, parts.length - 1))}%, var(--card))`;
  $("stages").replaceChildren(
    element("div", { class: "flow" }, ...parts.map(([stage, time], index) =>
      element("i", { swatch: shade(index), width: `${100 * time / sum}%`, title: `${stage}: ${ms(time)}` }))),
    element("div", { class: "keys" }, ...parts.map(([stage, time], index) =>
      element("div", {}, element("span", { swatch: shade(index) }, stage), ms(time)))));
}

// ---- legend: the same entries at every tick, so that nothing moves under the pointer ----

let shown = "";
function legend(frame) {
  const known = [...order].filter((cav) => frame.vehicles.some((vehicle) => vehicle.cav === cav) || view.hidden.has(`points ${cav}`));
  const entries = [
    ["hit", "detection, matches an object", "var(--hit)", "solid"], ["wrong", "detection, matches none", "var(--wrong)", "solid"],
    ["truth", "object, found or not expected", "var(--truth)", "thin"], ["missed", "object, missed", "var(--truth)", "dashed"],
    ["single", "detections of single vehicles", "var(--faint)", "dotted"], ["area", "detection area of the ego", "var(--area)", "thin"],
    ["tracks", "track: number, path of 2 s", "var(--track)", "solid"],
    ["sigma", "95 % of the position (σ)", "var(--faint)", "round"],
    ["map", `feature map of ${focused(frame) || "a vehicle"}${heat.isMissing ? ": none" : ""}`, swatch(focused(frame) || ""), "shade"],
  ].concat(known.map((cav) => [`points ${cav}`, `vehicle ${cav}, its points`, swatch(cav), "dots"]));
  const key = JSON.stringify(entries);
  if (key === shown) return;
  shown = key;
  $("legend").replaceChildren(...entries.map(([layer, name, shade, kind]) => {
    const box = element("input", { type: "checkbox" });
    box.checked = !view.hidden.has(layer);
    box.addEventListener("change", () => {
      if (box.checked) view.hidden.delete(layer); else view.hidden.add(layer);
      refresh();
    });
    return element("label", { swatch: shade }, box, element("i", { class: kind }), name);
  }));
}

$("score").addEventListener("input", () => {
  view.score = Number($("score").value);
  $("scoretext").textContent = number(view.score, 2);
  refresh();
});
const isPhone = matchMedia("(max-width: 860px)");
if (isPhone.matches) $("legendbox").open = false;
