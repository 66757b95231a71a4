"""Checks of the page of `v2vloc view` and of a sweep's report, as a person uses them: mouse, keys, and what is shown."""

import json
import pathlib
import re
import urllib.request

from chromium import Tab

SCRIPT = (pathlib.Path(__file__).parent / "page_probe.js").read_text()
# Width of the images of the cameras, pixels.
IMAGE_WIDTH = 96


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
        self.none("nothing is cut", self.tab.value("probe.cut()"))
        self.none("nothing covers another control", self.tab.value("probe.overlaps()"))
        for is_dark in (True, False):
            self.tab.dark(is_dark)
            self.none(f"texts are legible {'in the dark' if is_dark else 'by day'}", self.tab.value("probe.faint()"))

    def images(self, seconds: float = 10) -> None:
        """Four cameras of the selected vehicle or the ego."""
        wanted = [IMAGE_WIDTH] * 4
        self.tab.wait(f"probe.images().join() === '{','.join(map(str, wanted))}'", seconds)
        self.same("images of four cameras", self.tab.value("probe.images()"), wanted)

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
        colours = self.tab.value("probe.colours()")
        self.true("the scene is drawn", colours > 20, f"{colours} colours")
        self.images()
        self.navigation()
        self.judgement()
        self.links()
        self.tracks()
        self.feature_map(pictures)
        self.skipped_tick(pictures)
        self.selection()
        self.none("every colour of the scene is in the legend", self.tab.value("probe.unexplained()"))
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
        tab.value("probe.setScore(0.2)")
        self.open_legend(False)

    def links(self) -> None:
        index = self.answered[-1]
        self.goes_to(index)
        mbps = "\\d+\\.\\d+ Mbit/s, \\d+(\\.\\d)? ms on the link, \\d.* waiting"
        self.becomes("rate, time and backlog of the links", "#serieshead", mbps)
        dark = self.tab.value("probe.strokes('series')")
        self.true("a line for each link in every strip", dark >= 3, f"{dark} lines")

    def tracks(self) -> None:
        tab, index = self.tab, self.answered[-1]
        self.goes_to(index)
        expected = [len(track["trail_m"]) for track in frame_of(self.address, index)["tracks"]]
        self.true("tracks with a path", max(expected, default=0) > 1, f"paths {expected}")
        self.same("every track is drawn, with its number", tab.value("probe.tracks()"), {"paths": expected, "numbers": len(expected)})
        self.open_legend(True)
        tab.value("probe.layer('track')")
        self.same("and can be hidden", tab.value("probe.tracks()"), {"paths": [], "numbers": 0})
        tab.value("probe.layer('track')")
        self.open_legend(False)

    def feature_map(self, pictures) -> None:
        tab = self.tab
        self.goes_to(self.answered[-1])
        self.open_legend(True)
        self.same("no feature map at first", tab.value("heat.image"), None)
        tab.value("probe.layer('feature map')")
        tab.wait("heat.image !== null")
        self.same("a feature map is drawn", tab.value("probe.maps()"), 1)
        self.same("of this moment", tab.value("heat.capture_s === view.frame.capture_s"), True)
        self.open_legend(False)
        tab.screenshot(pictures("feature-map"))
        tab.value("probe.layer('feature map')")
        self.same("and can be hidden", tab.value("probe.maps()"), 0)

    def open_legend(self, is_open: bool) -> None:
        """On a phone the legend is closed at first."""
        if self.tab.width < 860 and self.tab.value("document.getElementById('legendbox').open") != is_open:
            self.tab.click_on("#legendbox summary")

    def boxes(self) -> int:
        """Number of detections in the scene."""
        return self.tab.value("probe.detections().length")

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
        self.becomes("a tick without a result says so, with the age of what is shown", "#banner",
                     "leaves it out.* " + re.escape(f"{age:.1f} s"))
        self.same("and counts what is shown", self.tab.value(text("#judged")), counts(frame_of(self.address, before), 0.2))
        vehicles = self.tab.value("[...document.querySelectorAll('#vehicles small')].map((node) => node.textContent)")
        self.none("no vehicle of it seems to have failed", [status for status in vehicles if status.startswith("no pose")])
        self.tab.screenshot(pictures("skipped"))
        self.none("nothing covers another control then", self.tab.value("probe.overlaps()"))

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
        self.click_drawn("probe.marks()")
        self.becomes("a vehicle of the scene is selected", "#card", "Vehicle \\d+")
        tab.click_on("#card button")
        self.click_drawn("probe.detections()")
        self.becomes("a detection is selected", "#card", "Detection.*score0\\.\\d\\d")
        self.becomes("the pointer on a detection shows its score", "#tip", "score 0\\.\\d\\d")

    def click_drawn(self, strokes: str) -> None:
        """Clicks on one of what was drawn, the furthest from the middle: there no vehicle is in front of a box."""
        places = self.tab.value(f"probe.places({strokes})")
        self.true(f"something to click on of {strokes}", places, "nothing is in view")
        if places:
            self.tab.click(*places[0])


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
        colours = self.tab.value("probe.colours()")
        self.true("the scene is drawn", colours > 20, f"{colours} colours")
        self.becomes("counts", "#judged", "^\\d+ / \\d+ / \\d+$")
        self.becomes("AP", "#precision", "^\\d+\\.\\d %$")
        self.none("every colour of the scene is in the legend", self.tab.value("probe.unexplained()"))
        self.images(20)
        self.tab.wait("document.getElementById('seriesbox').checkVisibility()", 20)
        self.becomes("rate and time of the links", "#serieshead", "Mbit/s, .* on the link", 20)
        self.tab.screenshot(pictures("live"))
        self.other_ego()
        for has_router, words in ((True, "last message 4 s ago"), (False, "router gone, last message 4 s ago")):
            status = {"silent_s": 4.2, "is_over": False, "has_router": has_router}
            self.same("a run that has fallen silent", self.tab.value(f"probe.stateOf({json.dumps(status)})"), words)
        waits = "ego-1000: late needs boxes, agent 1000 publishes pose, bev (for 12 s)"
        for problems, words in (([], "no result for 12 s"), ([waits], waits)):
            status = {"silent_s": 0.1, "unanswered_s": 12.3, "problems": problems, "is_over": False, "has_router": True}
            self.same("a run without results", self.tab.value(f"probe.stateOf({json.dumps(status)})"), words)
        twice = "ego-1000: two senders use cav/1001/bev: both are rejected (for 3 s)"
        status = {"silent_s": 0.1, "unanswered_s": 0.1, "problems": [twice], "is_over": False, "has_router": True}
        self.same("a run with results and a problem", self.tab.value(f"probe.stateOf({json.dumps(status)})"), "live")
        self.same("names the problem", self.tab.value(text("#problems")), twice)

    def other_ego(self) -> None:
        self.tab.wait("document.querySelectorAll('#ego option').length === 2", 20)
        shown, other = self.tab.value("[view.answered.ego, [...document.querySelectorAll('#ego option')].map((one) => one.value).find((one) => one !== view.answered.ego)]")
        self.tab.value(f"probe.select('#ego', '{other}')")
        self.tab.wait(f"view.answered && view.answered.ego === '{other}'", 20)
        self.same("another ego's view", self.tab.value("view.answered.ego"), other)
        self.tab.value(f"probe.select('#ego', '{shown}')")
        self.tab.wait(f"view.answered && view.answered.ego === '{shown}'", 20)

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


class CausesPage(Checks):
    """A live run at `address` whose processes fail."""

    def __init__(self, tab: Tab, address: str):
        super().__init__(tab, "causes")
        tab.open(address)

    def plays(self) -> None:
        self.becomes("state", "#state", "^live$", 30)

    def loses_ego(self) -> None:
        self.becomes("names the ego without results", "#state", "no result for \\d+", 10)

    def loses_router(self) -> None:
        self.becomes("says that the router is gone", "#state", "^router gone, last message", 10)

    def names_twice(self) -> None:
        self.becomes("names the name used twice", "#problems", r"two senders use \w+/\w+: both are rejected", 20)
        self.layout()

    def names_outages(self, times: int) -> None:
        count = "" if times == 1 else rf" in all \({times} times\)"
        self.becomes("names the outage", "#problems", rf"observed: router gone for \d+\.\d s{count}$", 20)
        self.layout()


class ReportPage(Checks):
    """Report of a sweep, a file at `address`."""

    def __init__(self, tab: Tab, address: str):
        super().__init__(tab, "report")
        self.address = address

    def run(self, pictures) -> None:
        self.tab.open(self.address)
        columns = self.tab.value("probe.columns()")
        self.true("a table of the runs", columns and len(columns[0][1]) > 1, f"columns {columns}")
        self.none("only columns that vary", [head for head, texts in columns if len(set(texts)) < 2])
        self.same("the best precision is marked", self.tab.value("document.querySelectorAll('td b').length > 0"), True)
        self.same("a chart", self.tab.value("document.querySelectorAll('figure svg').length > 0"), True)
        self.layout()
        self.tab.screenshot(pictures("report"))
        self.quiet()
