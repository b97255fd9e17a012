"""The page of `raytwin explore`: who is answered, and the page in a browser: numbers, speed, nothing from elsewhere."""

import contextlib
import html
import http.client
import json
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

import raytwin as rt
from raytwin.acquisition.setting import Filter
from raytwin.campaign.sweep_file import read_campaign

pytest.importorskip("bokeh", reason="the extra `explore` is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
MOVES = 200
SLOWEST_MS = 200.0  # 95th percentile from a move to the drawn answer, on a machine that does nothing else

# a move as a slider makes it, until the answer to it is drawn; a dead page is an answer after 20 s
MOVE = """
([name, value]) => new Promise((done) => {
  const bokeh = Bokeh.documents[0], answer = bokeh.get_model_by_name('numbers').tags[0]
  const start = performance.now()
  const timer = setTimeout(() => done(20000), 20000)
  const seen = () => {
    answer.properties.data.change.disconnect(seen)
    requestAnimationFrame(() => setTimeout(() => { clearTimeout(timer); done(performance.now() - start) }, 0))
  }
  answer.properties.data.change.connect(seen)
  bokeh.get_model_by_name(name).value = value
})
"""
READY = "window.Bokeh && Bokeh.documents.length > 0 && Bokeh.documents[0].get_model_by_name('numbers') != null"


@contextlib.contextmanager
def running(folder: Path) -> Iterator[str]:
    """The command in a process of its own; its address."""
    command = [sys.executable, "-m", "raytwin", "explore", "virtual_lab", "--no-browser", "--port", "0", "--json"]
    command += ["--campaign", str(folder / "campaign.toml")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("}"):
                break
        yield str(json.loads("".join(lines))["address"])
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30)


def answer_of(address: str, path: str = "/", method: str = "GET", **headers: str) -> http.client.HTTPResponse:
    """One request to the server, with headers of one's own."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=30)
    connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer


def test_only_this_page_of_this_machine_is_answered(tmp_path: Path) -> None:
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }
    with running(tmp_path) as address:
        host = urlsplit(address).netloc
        assert host.startswith("127.0.0.1:")
        assert answer_of(address, Host="raytwin.example").status == 403  # a foreign name that resolves to this machine
        assert answer_of(address, Origin="http://raytwin.example").status == 403
        assert answer_of(address, "/ws", Origin="http://raytwin.example", **upgrade).status == 403
        assert (
            answer_of(address, "/ws", Origin=f"http://127.0.0.1:{int(host.split(':')[1]) + 1}", **upgrade).status == 403
        )
        assert answer_of(address, "/ws", **upgrade).status == 403
        assert answer_of(address, method="POST").status == 405
        for path in ("/autoload.js", "/metadata", "/static/../../etc/passwd", "/other"):
            assert answer_of(address, path).status in (403, 404), path
        page = answer_of(address)
        assert page.status == 200
        assert "frame-ancestors 'none'" in str(page.headers["Content-Security-Policy"])
        assert "default-src 'self'" in str(page.headers["Content-Security-Policy"])
        assert answer_of(address).status == 503  # while the first page opens
        busy = subprocess.run(
            [sys.executable, "-m", "raytwin", "explore", "virtual_lab", "--no-browser", "--port", host.split(":")[1]],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        assert busy.returncode == 2
        assert re.search(r"--port: got \d+ \(.*in use\); expected a free port", busy.stderr)


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    folder = tmp_path_factory.mktemp("explore")
    with running(folder) as address:
        yield address, folder


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed: pip install playwright"
    )
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"]
        )
        yield opened
        opened.close()


@pytest.fixture
def page(browser, line) -> Iterator[object]:  # type: ignore[no-untyped-def]
    """The page, open and still; what it asked for and what went wrong in it are on it."""
    context = browser.new_context(
        viewport={"width": 1200, "height": 900}, permissions=["clipboard-read", "clipboard-write"]
    )
    opened = context.new_page()
    opened.asked, opened.wrong = [], []
    context.on("request", lambda request: opened.asked.append(request.url))
    opened.on("websocket", lambda socket: opened.asked.append(socket.url))
    opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
    opened.on("console", lambda text: opened.wrong.append(text.text) if text.type == "error" else None)
    for _ in range(10):  # the page before this one may still be closing
        if opened.goto(line[0]).status == 200:
            break
        opened.wait_for_timeout(1000)
    opened.wrong.clear()
    opened.wait_for_function(READY)
    opened.wait_for_function("document.body.innerText.length > 0")
    opened.wait_for_timeout(1500)
    yield opened
    assert opened.wrong == []
    context.close()


def shown(page, name: str) -> str:  # type: ignore[no-untyped-def]
    """The text of a part of the page, as HTML."""
    return str(page.evaluate("name => Bokeh.documents[0].get_model_by_name(name).text", name))


def plain(text: str) -> str:
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<style>.*?</style>|<[^>]*>", " ", text, flags=re.DOTALL)))


def _share_of_a_core() -> float:
    """Processor time over time of some milliseconds of work: 1 where no other process wants the core."""
    wall, used = time.perf_counter(), time.process_time()
    while time.process_time() - used < 0.02:
        pass
    return (time.process_time() - used) / (time.perf_counter() - wall)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
class TestInChromium:
    def test_moved_sliders_show_the_numbers_of_the_api(self, page) -> None:  # type: ignore[no-untyped-def]
        before = shown(page, "numbers")
        handle = page.locator(".low .noUi-handle").first
        handle.focus()
        for _ in range(6):  # half a kV each
            page.keyboard.press("ArrowRight")
        page.wait_for_function(
            "Bokeh.documents[0].get_model_by_name('numbers').text.includes('low, 43 kV')", timeout=10_000
        )
        page.wait_for_timeout(500)
        page.evaluate(MOVE, ["product_mm", 25])
        page.evaluate(MOVE, ["foreign_object", "Al"])
        page.wait_for_timeout(300)
        text = plain(shown(page, "numbers"))
        assert shown(page, "numbers") != before
        twin = rt.read_twin("virtual_lab")
        low = "kv=43,power_w=45,exposure_ms=20,filter=Cu:0.05"
        high = "kv=90,power_w=45,exposure_ms=20,filter=Cu:0.05"
        level, noise = twin.predict(low).mean_DN, twin.predict(high).sd_DN  # type: ignore[union-attr]
        assert f"{level.value:.1f} ({level.low:.1f} to {level.high:.1f})" in text
        assert f"{noise.value:.2f} ({noise.low:.2f} to {noise.high:.2f})" in text
        found = rt.contrast(twin=twin, low=low, high=high, product="chicken_breast:25", foreign_object="Al:1").contrast
        tiles = plain(shown(page, "tiles"))
        assert f"{found.cnr_object:.3g} contrast to noise of the object" in tiles
        assert f"{found.delta_R.value:.3g}" in tiles

    def test_the_map_is_there_and_follows_what_is_set(self, page) -> None:  # type: ignore[no-untyped-def]
        def best() -> float:
            return float(re.search(r"best on the map, ([\d.]+) at", plain(shown(page, "map_note")))[1])  # type: ignore[index]

        def drawn() -> list[float]:
            found = page.evaluate(
                "() => { const m = Bokeh.documents[0].get_model_by_name('map');"
                " return Array.from(m.renderers[0].data_source.get('cnr')) }"
            )
            return [float(one) for one in found]

        first = best()
        assert max(drawn()) == pytest.approx(first, rel=0.01)
        page.evaluate(MOVE, ["averaged", 4])
        page.wait_for_function(
            "Bokeh.documents[0].get_model_by_name('map_note').text.includes('best on the map')", timeout=10_000
        )
        # four frames halve the noise, at any pair
        assert best() == pytest.approx(2.0 * first, rel=0.01)
        assert max(drawn()) == pytest.approx(best(), rel=0.01)

    def test_nothing_is_asked_of_another_machine(self, page) -> None:  # type: ignore[no-untyped-def]
        assert len(page.asked) > 3
        assert {urlsplit(url).hostname for url in page.asked if not url.startswith(("data:", "blob:"))} == {"127.0.0.1"}
        assert any(url.startswith("ws://127.0.0.1:") for url in page.asked)
        assert page.evaluate("fetch('http://raytwin.example/').then(() => 'sent', () => 'refused')") == "refused"
        assert any("Content Security Policy" in text for text in page.wrong)
        page.wrong.clear()

    def test_a_second_page_is_refused_and_opens_when_the_first_is_closed(self, page, browser, line) -> None:  # type: ignore[no-untyped-def]
        second = browser.new_page()
        answer = second.goto(line[0])
        assert answer.status == 503
        assert "open in another window" in second.content()
        page.goto("about:blank")
        second.wait_for_function(READY, timeout=20_000)  # it asks again by itself
        second.close()

    def test_limits_are_red_and_what_cannot_be_read_is_said(self, page) -> None:  # type: ignore[no-untyped-def]
        page.evaluate(MOVE, ["power_high", 130])
        assert "Not possible: 90 kV: 130 W; at most the tube's 90 W" in plain(shown(page, "limits"))
        colour = page.locator(".broken li").first.evaluate("node => getComputedStyle(node).color")
        assert colour == "rgb(176, 0, 32)"
        page.evaluate(MOVE, ["power_high", 45])
        assert shown(page, "limits") == ""
        page.evaluate(MOVE, ["product", "unobtainium"])
        assert "unobtainium" in plain(shown(page, "limits"))

    def test_what_is_seen_is_copied_and_added_to_a_campaign(self, page, line) -> None:  # type: ignore[no-untyped-def]
        page.evaluate(MOVE, ["kV_low", 52])
        page.get_by_role("button", name="Copy command").click()
        page.wait_for_timeout(300)
        copied = page.evaluate("navigator.clipboard.readText()")
        assert copied.splitlines()[0] == (
            "raytwin predict virtual_lab --kv 52 --filter Cu:0.05 --power-w 45 --exposure-ms 20"
        )
        page.get_by_role("button", name="Add to campaign").click()
        page.wait_for_function("Bokeh.documents[0].get_model_by_name('added').text != ''")
        campaign = read_campaign(line[1] / "campaign.toml")
        assert [one.kV for one in campaign.settings[-1]] == [52.0, 90.0]
        assert campaign.settings[-1][0].filters == (Filter(material="Cu", thickness_mm=0.05),)

    @pytest.mark.parametrize("width", [1200, 400])
    def test_nothing_overlaps_or_runs_out_of_the_page(self, page, width: int) -> None:  # type: ignore[no-untyped-def]
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_timeout(1000)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        boxes = page.evaluate(
            "[...document.querySelectorAll('section')].map(n => { const b = n.getBoundingClientRect();"
            " return [b.left, b.top, b.right, b.bottom] })"
        )
        assert len(boxes) == 9
        for number, (left, top, right, bottom) in enumerate(boxes):
            assert right - left > 100 and bottom - top > 40
            for other in boxes[number + 1 :]:
                apart = right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
                assert apart, (boxes[number], other)

    def test_answers_to_random_moves_come_within_a_fifth_of_a_second(self, page) -> None:  # type: ignore[no-untyped-def]
        names = ["kV_low", "kV_high", "power_low", "power_high", "filter_low_mm", "filter_high_mm", "exposure"]
        names += ["averaged", "distance", "product_mm", "object_mm", "object_pixels"]
        rng = random.Random(7)
        times, shares = [], []
        while len(times) < MOVES:
            name = rng.choice(names)
            start, end, step, value = page.evaluate(
                "name => { const m = Bokeh.documents[0].get_model_by_name(name); return [m.start, m.end, m.step, m.value] }",
                name,
            )
            wanted = start + step * rng.randint(0, round((end - start) / step))
            if abs(wanted - value) < 0.5 * step:
                continue
            times.append(page.evaluate(MOVE, [name, wanted]))
            shares.append(_share_of_a_core())
            page.wait_for_timeout(rng.choice([0, 100, 500]))
        share = float(np.mean(shares))
        print(f"share of a core that a process gets: {share:.2f}")
        print(
            f"move to drawn answer: median {np.median(times):.0f} ms, 95th percentile {np.quantile(times, 0.95):.0f} ms"
        )
        assert share * np.quantile(times, 0.95) <= SLOWEST_MS
