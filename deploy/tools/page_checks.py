"""Checks of the page of `v2vloc view` and of a sweep's report, as a person uses them: mouse, keys, and what is shown."""

import json
import re
import urllib.request

from chromium import Tab

# Records what is drawn on the scene since `drawn.length = 0`: paths with their colour, and texts.
SCRIPT = """
const drawn = [];
for (const [name, style] of [["stroke", "strokeStyle"], ["fill", "fillStyle"], ["fillText", "fillStyle"]]) {
  const original = CanvasRenderingContext2D.prototype[name];
  CanvasRenderingContext2D.prototype[name] = function (...given) {
    if (this.canvas.id === "scene") drawn.push({ name, colour: this[style], path: [...(this.path || [])], width: this.lineWidth, text: given[0] });
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
// Every colour as the canvas spells it.
const spelt = (colour) => { const pen = document.createElement("canvas").getContext("2d"); pen.fillStyle = colour; return pen.fillStyle; };
const property = (name) => spelt(getComputedStyle(document.documentElement).getPropertyValue(name).trim());
"""

COLOURS = """(() => { const canvas = document.getElementById("scene");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height), found = new Set();
  for (let at = 0; at < data.length; at += 4) found.add(data[at] << 16 | data[at + 1] << 8 | data[at + 2]);
  return found.size; })()"""

# Colours of strokes and fills of the scene that no entry of the legend has; rings, texts and the sheet need none.
UNEXPLAINED = """(() => { drawn.length = 0; draw();
  const colours = [...document.querySelectorAll("#legend label")].map((label) => spelt(getComputedStyle(label).getPropertyValue("--swatch").trim()
    .replace(/^var\\((.*)\\)$/, (_, name) => getComputedStyle(document.documentElement).getPropertyValue(name))));
  const free = ["--grid", "--sheet"].map(property);
  return [...new Set(drawn.filter((stroke) => stroke.name !== "fillText").map((stroke) => stroke.colour))]
    .filter((colour) => !colours.includes(colour) && !free.includes(colour)); })()"""

# Texts with less than the contrast of 4.5 that WCAG 2 asks for.
FAINT = """(() => {
  const channels = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const luminance = ([r, g, b]) => [r, g, b].map((c) => (c /= 255) <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
    .reduce((sum, c, at) => sum + c * [0.2126, 0.7152, 0.0722][at], 0);
  const behind = (node) => { for (; node; node = node.parentElement) { const at = channels(getComputedStyle(node).backgroundColor); if (at.length < 4 || at[3] > 0) return at; } return [255, 255, 255]; };
  const found = new Set();
  for (const node of document.querySelectorAll("body *")) {
    const own = [...node.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim());
    if (!own || !node.checkVisibility()) continue;
    const [a, b] = [luminance(channels(getComputedStyle(node).color)), luminance(behind(node))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) found.add(`${node.textContent.trim().slice(0, 30)} (${ratio.toFixed(1)})`);
  }
  return [...found]; })()"""

# Texts that are cut, or reach out of the window, other than in a part that scrolls.
CUT = """(() => { const found = [];
  for (const node of document.querySelectorAll("body *")) {
    if (!node.checkVisibility() || node.closest("canvas, svg, input, select, option") || node.closest(".wide, pre") !== null) continue;
    const { right, left, width } = node.getBoundingClientRect();
    if (!width || !node.textContent.trim()) continue;
    if (right > innerWidth + 1 || left < -1) found.push(`${node.tagName} ${node.id} ends at ${Math.round(right)} of ${innerWidth}`);
    else if (node.scrollWidth > node.clientWidth + 1 && node.clientWidth) found.push(`${node.tagName} ${node.id || node.textContent.trim().slice(0, 30)}: ${node.scrollWidth} in ${node.clientWidth}`);
  }
  return found; })()"""

# Controls and notes over the scene that cover each other.
OVERLAPS = """(() => { const nodes = [...document.querySelectorAll(".tools, .legend, .card, .banner, .hint")].filter((node) => node.checkVisibility());
  const boxes = nodes.map((node) => [node.className, node.getBoundingClientRect()]), found = [];
  boxes.forEach(([a, p], index) => boxes.slice(index + 1).forEach(([b, q]) => {
    if (p.left < q.right && q.left < p.right && p.top < q.bottom && q.top < p.bottom) found.push(`${a} over ${b}`); }));
  return found; })()"""

# Width of the images of the cameras, pixels.
IMAGE_WIDTH = 96
IMAGES = "[...document.querySelectorAll('#images img')].map((image) => image.naturalWidth)"

# Words for a status of the server.
STATE_OF = """(async () => { const real = fetch; window.fetch = async () => new Response(%s);
  try { await check(); } finally { window.fetch = real; }
  return document.getElementById("state").textContent; })()"""


def text(selector: str) -> str:
    return f"document.querySelector({json.dumps(selector)}).textContent"


class Checks:
    """Results of the checks of one page, printed as they come."""

    def __init__(self, tab: Tab, name: str):
        self.tab, self.name = tab, f"{tab.width}x{tab.height} {name}"
        self.failures = 0

    def same(self, what: str, found, expected) -> None:
        self.true(what, found == expected, f"expected {expected!r}, found {found!r}")

    def none(self, what: str, found: list) -> None:
        self.true(what, not found, f"found {'; '.join(map(str, found))}")

    def true(self, what: str, is_true, otherwise: str) -> None:
        self.failures += not is_true
        print(f"{'ok    ' if is_true else 'FAILED'} {self.name}: {what}{'' if is_true else f': {otherwise}'}", flush=True)

    def becomes(self, what: str, selector: str, pattern: str, seconds: float = 10) -> None:
        """The text of an element matches a pattern within some seconds."""
        self.tab.wait(f"new RegExp({json.dumps(pattern)}).test({text(selector)})", seconds)
        found = self.tab.value(text(selector))
        self.true(what, re.search(pattern, found), f"expected {pattern!r}, found {found!r}")

    def layout(self) -> None:
        """What holds for every page and state."""
        self.same("no horizontal scrolling", self.tab.value("document.documentElement.scrollWidth <= innerWidth"), True)
        self.none("nothing is cut", self.tab.value(CUT))
        self.none("nothing covers another control", self.tab.value(OVERLAPS))
        for is_dark in (True, False):
            self.tab.dark(is_dark)
            self.none(f"texts are legible {'in the dark' if is_dark else 'by day'}", self.tab.value(FAINT))

    def images(self, seconds: float = 10) -> None:
        """Four cameras of the selected vehicle or the ego."""
        wanted = [IMAGE_WIDTH] * 4
        self.tab.wait(f"JSON.stringify({IMAGES}) === '{json.dumps(wanted, separators=(',', ':'))}'", seconds)
        self.same("images of four cameras", self.tab.value(IMAGES), wanted)

    def quiet(self) -> None:
        self.none("no error in the console, no failed request", self.tab.problems)


def frame_of(address: str, index: int) -> dict:
    """JSON document of a moment, as the server sends it."""
    body = urllib.request.urlopen(f"{address}frame/{index}").read()
    length = int.from_bytes(body[:4], "little")
    return json.loads(body[4:4 + length])


def timeline_of(address: str) -> list[dict]:
    return json.load(urllib.request.urlopen(f"{address}run"))["timeline"]


def counts(frame: dict, score: float) -> str:
    """True positives, false positives and missed objects from a score on, as the page writes them."""
    shown = [box for box in frame["detections"] if box["score"] >= score]
    hits = sum(bool(box["is_hit"]) for box in shown)
    missed = sum(box["is_counted"] and (box["found_score"] or 0) < score for box in frame["truth"])
    return f"{hits} / {len(shown) - hits} / {missed}"


class RecordedPage(Checks):
    """A recorded run at `address`."""

    def __init__(self, tab: Tab, address: str):
        super().__init__(tab, "recorded")
        self.address, self.timeline = address, timeline_of(address)
        self.last = len(self.timeline)
        self.answered = [at for at, moment in enumerate(self.timeline) if moment["latency_ms"] is not None]
        self.skipped = [at for at, moment in enumerate(self.timeline) if moment["latency_ms"] is None and at > self.answered[0]]

    def moment(self) -> int:
        """Number of the moment that is shown, from 1."""
        return int(self.tab.value(text("#moment")).split()[0])

    def waits_for(self, number: int) -> int:
        self.tab.wait(f"{text('#moment')}.startsWith('{number} of')")
        return self.moment()

    def goes_to(self, index: int) -> None:
        """Opens the link to a moment, without loading the page again."""
        self.tab.value(f"void (location.hash = '#at={index}')")
        self.waits_for(index + 1)

    def run(self, pictures) -> None:
        self.tab.open(f"{self.address}#at={self.answered[0]}")
        self.tab.wait("document.documentElement.dataset.frames > 0")
        self.same("a link opens its moment", self.waits_for(self.answered[0] + 1), self.answered[0] + 1)
        self.same("state", self.tab.value(text("#state")), "recorded")
        colours = self.tab.value(COLOURS)
        self.true("the scene is drawn", colours > 20, f"{colours} colours")
        self.images()
        self.navigation()
        self.judgement()
        self.skipped_tick(pictures)
        self.selection()
        self.none("every colour of the scene is in the legend", self.tab.value(UNEXPLAINED))
        self.layout()
        self.tab.screenshot(pictures("recorded"))
        self.tab.dark(True)
        self.tab.screenshot(pictures("recorded-dark"))
        self.quiet()

    def navigation(self) -> None:
        tab = self.tab
        tab.slide("#seek", 0.5)
        middle = self.waits_for(int(tab.value("document.getElementById('seek').value")) + 1)
        self.true("the slider moves", 0.3 < middle / self.last < 0.7, f"moment {middle} of {self.last}")
        shown = f"{self.timeline[middle - 1]['capture_s']:.1f} s"
        self.becomes("the time is that of the moment", "#time", f"^{re.escape(shown)}$")
        tab.key("ArrowRight")
        self.same("right arrow after the slider", self.waits_for(middle + 1), middle + 1)
        tab.key("ArrowLeft")
        self.same("left arrow after the slider", self.waits_for(middle), middle)
        tab.key(" ")
        self.becomes("space plays", "#play", "^pause$")
        tab.wait(f"!{text('#moment')}.startsWith('{middle} of')")
        tab.key(" ")
        self.becomes("space stops", "#play", "^play$")
        tab.click_on("#ahead")
        tab.slide("#seek", 1)
        self.same("the slider reaches the end", self.waits_for(self.last), self.last)
        tab.click_on("#back")
        self.same("back", self.waits_for(self.last - 1), self.last - 1)
        tab.key("ArrowRight")
        self.same("right arrow after a button", self.waits_for(self.last), self.last)
        tab.click_on("#play")
        tab.wait(f"parseInt({text('#moment')}) < {self.last}")
        self.true("play at the end starts again", self.moment() < self.last, f"still at {self.moment()}")
        tab.click_on("#play")
        wrong = [sum(moment["judged"][1:]) if moment["judged"] else -1 for moment in self.timeline]
        tab.click_on("#worst")
        self.same("worst", self.waits_for(wrong.index(max(wrong)) + 1), wrong.index(max(wrong)) + 1)

    def judgement(self) -> None:
        tab = self.tab
        for index in (self.answered[0], self.answered[-1]):
            self.goes_to(index)
            frame, moment = frame_of(self.address, index), self.timeline[index]
            self.same(f"counts of moment {index + 1}", tab.value(text("#judged")), " / ".join(map(str, moment["judged"])))
            self.same(f"AP until moment {index + 1}", tab.value(text("#precision")), f"{100 * frame['ap_50']:.1f} %")
        self.open_legend(True)
        before = self.boxes()
        tab.slide("#score", 1)
        self.same("score after the slider", tab.value(text("#scoretext")), "0.90")
        self.same("counts at that score", tab.value(text("#judged")), counts(frame, 0.9))
        after = self.boxes()
        self.true("a higher score hides boxes", 0 <= after < before, f"{before} before, {after} after")
        tab.slide("#score", 0)
        self.same("counts at the lowest score", tab.value(text("#judged")), counts(frame, 0.1))
        tab.value("(() => { const score = document.getElementById('score'); score.value = 0.2; score.dispatchEvent(new Event('input')); score.blur(); })()")
        self.open_legend(False)

    def open_legend(self, is_open: bool) -> None:
        """On a phone the legend is closed at first."""
        if self.tab.width < 860 and self.tab.value("document.getElementById('legendbox').open") != is_open:
            self.tab.click_on("#legendbox summary")

    def boxes(self) -> int:
        """Number of detections in the scene."""
        return self.tab.value("(() => { drawn.length = 0; draw(); return drawn.filter((stroke) => stroke.name === 'stroke' &&"
                              " [property('--hit'), property('--wrong')].includes(stroke.colour)).length; })()")

    def skipped_tick(self, pictures) -> None:
        if not self.skipped:
            self.true("a tick without a result", False, "the run has none")
            return
        # Not after its predecessor: what is shown must not depend on the way there.
        index = self.skipped[-1]
        self.goes_to(self.answered[0])
        self.goes_to(index)
        before = max(at for at in self.answered if at < index)
        age = self.timeline[index]["capture_s"] - self.timeline[before]["capture_s"]
        self.becomes("a tick without a result says so, with the age of what is shown", "#banner", "leaves it out.* " + re.escape(f"{age:.1f} s"))
        self.same("and counts what is shown", self.tab.value(text("#judged")), counts(frame_of(self.address, before), 0.2))
        vehicles = self.tab.value("[...document.querySelectorAll('#vehicles small')].map((node) => node.textContent)")
        self.none("no vehicle of it seems to have failed", [status for status in vehicles if status.startswith("no pose")])
        self.tab.screenshot(pictures("skipped"))
        self.none("nothing covers another control then", self.tab.value(OVERLAPS))

    def selection(self) -> None:
        tab = self.tab
        self.goes_to(self.answered[-1])
        tab.value("scrollTo(0, 0)")
        frame = frame_of(self.address, self.answered[-1])
        cav = frame["vehicles"][0]["cav"]
        tab.click_on("#vehicles button")
        self.becomes("a vehicle of the list is selected", "#card", f"Vehicle {cav}")
        tab.click_on("#vehicles button")
        tab.value("scrollTo(0, 0)")
        self.click_drawn("path.length === 1 && path[0][2] === 5", "stroke")
        self.becomes("a vehicle of the scene is selected", "#card", "Vehicle \\d+")
        tab.click_on("#card button")
        # The box furthest from the vehicles is not one of theirs.
        self.click_drawn("path.length === 6 && [property('--hit'), property('--wrong')].includes(colour)", "stroke")
        self.becomes("a detection is selected", "#card", "Detection.*score0\\.\\d\\d")

    def click_drawn(self, condition: str, name: str) -> None:
        """Clicks on the middle of what was drawn and meets a condition, of those in view the furthest from the middle."""
        left, top, width, height = self.tab.box("#scene")
        found = self.tab.value(
            "(() => { drawn.length = 0; draw(); const free = [...document.querySelectorAll('.tools, .legend, .card, .banner')]"
            ".filter((node) => node.checkVisibility()).map((node) => node.getBoundingClientRect());"
            f"return drawn.filter(({{ name, colour, path }}) => name === '{name}' && {condition})"
            ".map(({ path }) => { const corners = path.slice(0, 4); return [0, 1].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length); })"
            f".filter(([u, v]) => u > 9 && v > 9 && u < {width} - 9 && v < {height} - 9 && !free.some((box) =>"
            f" u + {left} > box.left - 5 && u + {left} < box.right + 5 && v + {top} > box.top - 5 && v + {top} < box.bottom + 5)); }})()")
        if not found:
            self.true(f"something to click on ({condition})", False, "nothing is drawn")
            return
        u, v = max(found, key=lambda at: abs(at[0] - width / 2) + abs(at[1] - height * 0.55))
        self.tab.click(left + u, top + v)


class LivePage(Checks):
    """A live run at `address`."""

    def __init__(self, tab: Tab, address: str):
        super().__init__(tab, "live")
        self.address = address

    def opens(self, pictures) -> None:
        """Before anything is published."""
        self.tab.open(self.address)
        self.becomes("waits for the run", "#state", "^waiting for the run$")
        self.same("and says why nothing is shown", self.tab.value(text("#hint")), "Nothing is published in this run yet.")
        self.tab.screenshot(pictures("waiting"))

    def plays(self, pictures) -> None:
        self.becomes("state", "#state", "^live$", 30)
        self.tab.wait("document.documentElement.dataset.frames > 2", 30)
        colours = self.tab.value(COLOURS)
        self.true("the scene is drawn", colours > 20, f"{colours} colours")
        self.becomes("counts", "#judged", "^\\d+ / \\d+ / \\d+$")
        self.becomes("AP", "#precision", "^\\d+\\.\\d %$")
        self.none("every colour of the scene is in the legend", self.tab.value(UNEXPLAINED))
        self.images(20)
        self.tab.screenshot(pictures("live"))
        for has_router, words in ((True, "last message 4 s ago"), (False, "router gone, last message 4 s ago")):
            status = {"silent_s": 4.2, "is_over": False, "has_router": has_router}
            self.same("a run that has fallen silent", self.tab.value(STATE_OF % json.dumps(json.dumps(status))), words)

    def ends(self, pictures) -> None:
        self.becomes("says that the run has ended", "#state", "^ended \\d+(\\.\\d)? s ago$", 8)
        self.layout()
        self.tab.screenshot(pictures("ended"))

    def loses_router(self, pictures) -> None:
        self.becomes("says that the router is gone", "#state", "^ended \\d+(\\.\\d)? \\w+ ago, router gone$", 15)
        self.layout()
        self.tab.screenshot(pictures("router-gone"))
        self.quiet()

    def loses_viewer(self) -> None:
        self.becomes("says that `v2vloc view` is gone", "#state", "v2vloc view is gone", 5)


class ReportPage(Checks):
    """Report of a sweep, a file at `address`."""

    def __init__(self, tab: Tab, address: str):
        super().__init__(tab, "report")
        self.address = address

    def run(self, pictures) -> None:
        self.tab.open(self.address)
        columns = self.tab.value(
            "(() => { const rows = [...document.querySelectorAll('tbody tr')].map((row) => [...row.children].map((cell) => cell.textContent));"
            "return [...document.querySelectorAll('thead th')].map((head, at) => [head.textContent, new Set(rows.map((row) => row[at])).size, rows.length]); })()")
        self.true("a table of the runs", columns and columns[0][2] > 1, f"columns {columns}")
        self.none("only columns that vary", [name for name, values, _ in columns if values < 2])
        self.same("the best precision is marked", self.tab.value("document.querySelectorAll('td b').length > 0"), True)
        self.same("a chart", self.tab.value("document.querySelectorAll('figure svg').length > 0"), True)
        self.layout()
        self.tab.screenshot(pictures("report"))
        self.quiet()
