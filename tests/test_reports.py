"""Pages of results: self-contained, escaped, their numbers on them; in a browser at two widths nothing is asked of anyone."""

import base64
import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest

import raytwin as rt
from raytwin.errors import InputError
from raytwin.reports import (
    Band,
    Bars,
    Chart,
    KeyFigure,
    Line,
    Picture,
    Points,
    ResultPage,
    Rule,
    Section,
    SortedTable,
    Step,
    write_result_page,
)
from raytwin.reports.chart import mean_of_squares, rows_px, wrapped

DEMO = Path(__file__).parents[1] / "demo" / "report.html"
POD_TABLE = Path(__file__).parent / "pod_examples" / "hdbk_ex3.csv"
PRODUCTS = """
[[product]]
shape = "fillet"
material = "chicken_breast"
length_mm = [12, 16]
width_mm = [10, 14]
height_mm = [5, 8]
[[foreign_object]]
name = "rib"
shape = "rod"
material = "rib_bone"
length_mm = [2, 4]
diameter_mm = [1, 3]
[images]
with_foreign_object = 0.7
products = 4
"""


def example_page() -> ResultPage:
    """Every kind of mark, scale and part; a text that would be markup if it were not escaped."""
    x = np.array([1.0, 10.0, 100.0])
    chart = Chart(
        name="marks",
        alt="all marks",
        title="Marks <b>",
        marks=[
            Band(x=x, low=x - 0.5, high=2 * x, label="band"),
            Line(x=x, y=x, label="line", dashed=True),
            Points(
                x=x,
                y=2 * x,
                y_ends=(x, 3 * x),
                names=["a", "b", "<i>"],
                anchors=["row-1", "row-2", "row-3"],
                label="points",
            ),
            Rule(at=10.0, label="rule"),
            Rule(at=10.0, along="x"),
        ],
        x_label="load, mAs",
        x_scale="log",
        y_scale="log",
    )
    bars = Chart(
        name="bars",
        alt="bars",
        marks=[Bars(y=[0.0, 1.0], length=[3.0, 1.5], names=["first", "second"], numbers=True)],
        y_ticks={0.0: "first", 1.0: "second"},
        x_scale="linear",
        downwards=True,
    )
    bent = Chart(name="bent", alt="asinh", marks=[Line(x=[-100.0, 0.0, 100.0], y=[1.0, np.nan, 2.0])], x_scale="asinh")
    rows, columns = np.mgrid[:40, :60]
    picture = Picture(
        name="picture",
        alt="a ramp",
        values=np.where(rows == 3, np.nan, rows + columns.astype(float)),
        label="DN",
        ends=(0.0, 98.0),
        outline=(rows > 20) & (columns > 30),
    )
    table = SortedTable(
        header=("name", "value"),
        rows=(("a", "10 (9 to 11)"), ("b", "−2"), ("c", "3.5")),
        anchors=("row-1", "row-2", "row-3"),
        marked=frozenset({0}),
    )
    return ResultPage(
        heading="Heading <script>alert(1)</script>",
        answer=("An answer & more.",),
        key_figures=(KeyFigure(value="1", text="one"),),
        proof=(chart, bars, bent),
        steps=(Step(text="Do it.", command="raytwin info"),),
        sections=(Section(title="Fold", figures=(picture,), table=table, folded=True),),
    )


def numbers_of(page: str, name: str) -> list[list[str]]:
    found = re.search(rf'download="{name}\.csv" href="data:text/csv;charset=utf-8;base64,([^"]*)"', page)
    assert found is not None
    return list(csv.reader(io.StringIO(base64.b64decode(found[1]).decode())))


@pytest.mark.parametrize("interactive", [False, True])
def test_a_page_holds_its_numbers_escapes_its_texts_and_names_no_address(tmp_path: Path, interactive: bool) -> None:
    if interactive:
        pytest.importorskip("bokeh")
    path = write_result_page(tmp_path / "a.html", example_page(), version="1", interactive=interactive)
    page = path.read_text(encoding="utf-8")
    assert "<script>alert(1)" not in page and "Marks &lt;b&gt;" in page and "An answer &amp; more." in page
    assert "default-src 'none'" in page
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert re.findall(r'(?:src|href)="(?!data:)[^"]*"', markup) == []
    rows = numbers_of(page, "marks")
    assert rows[0] == ["mark", "x", "low", "high", "y", "name", "y_low", "y_high"]
    assert ["points", "10", "", "", "20", "b", "10", "30"] in rows
    assert ["line 1", "0", ""] in numbers_of(page, "bent")  # what is not finite is left empty
    assert numbers_of(page, "picture")[1][:3] == ["1", "2", "3"]
    again = write_result_page(tmp_path / "b.html", example_page(), version="1", interactive=interactive)
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("values", "ticks"),
    [
        ((50.0, 3000.0), (50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)),
        ((1.0, 10.0), (1.0, 2.0, 5.0, 10.0)),
        ((1.0, 9.0), ()),  # equal steps are better
        ((1.0, 101.0), ()),  # powers of ten are enough
        ((0.0, np.nan), ()),
    ],
)
def test_a_logarithmic_axis_of_one_to_two_decades_has_ticks_at_1_2_and_5(values, ticks) -> None:  # type: ignore[no-untyped-def]
    for mark in (Points(x=values, y=[1.0, 1.0]), Band(x=[0.0, 1.0], low=[values[0]] * 2, high=[values[1]] * 2)):
        axis = "x" if isinstance(mark, Points) else "y"
        chart = Chart(name="a", alt="a", marks=[mark], **{f"{axis}_scale": "log"})
        inside = tuple(tick for tick in chart.ticks_of_short_log(axis) if values[0] <= tick <= values[1])
        assert inside == ticks
        assert Chart(name="a", alt="a", marks=[mark]).ticks_of_short_log(axis) == ()
    ended = Chart(name="a", alt="a", marks=[Points(x=[5.0], y=[1.0])], x_scale="log", x_ends=(1.0, 20.0))
    assert ended.ticks_of_short_log("x")


def test_rows_are_as_high_as_the_name_of_most_lines() -> None:
    long = "radiation scattered by the object + noise common to rows or columns"
    assert rows_px(["a", "b"]) == 2 * rows_px(["a"])
    assert rows_px(["a", long]) == 2 * rows_px([long]) > 2 * rows_px(["a"])
    assert rows_px([long]) >= 12 * (wrapped(long).count("\n") + 1)  # letters of 11 px


def test_a_mark_with_columns_of_two_lengths_is_refused() -> None:
    with pytest.raises(InputError, match="columns of one length"):
        Chart(name="c", alt="", marks=[Line(x=[1, 2], y=[1, 2, 3])])


def test_a_large_picture_is_shown_as_means_of_squares_of_what_is_finite() -> None:
    values = np.arange(35, dtype=float).reshape(5, 7)
    values[0, 0] = np.nan
    shown = mean_of_squares(values, 2)
    assert shown.shape == (3, 4)
    assert shown[0, 0] == pytest.approx((1 + 7 + 8) / 3)
    assert shown[2, 3] == values[4, 6]


def test_results_have_pages_and_other_things_are_refused(tmp_path: Path) -> None:
    twin = rt.report("virtual_lab", tmp_path / "twin.html", interactive=False).read_text(encoding="utf-8")
    gain = rt.read_twin("virtual_lab").levels[0].gain_DN  # type: ignore[union-attr]
    assert f"{gain.value:.4g} ({gain.low:.4g} to {gain.high:.4g})" in twin
    curve = rt.fit_pod(POD_TABLE, link="logit")
    pod = rt.report(curve, tmp_path / "pod.html", interactive=False).read_text(encoding="utf-8")
    assert curve.a90 is not None and f"{curve.a90:.3g}" in pod
    # a table of hits is fitted as `fit_pod` does by default
    of_table = rt.report(POD_TABLE, tmp_path / "table.html", interactive=False).read_text(encoding="utf-8")
    usual = rt.fit_pod(POD_TABLE)
    assert usual.a90 is not None and f"{usual.a90:.3g}" in of_table
    with pytest.raises(InputError, match=r"ends in \.html"):
        rt.report(curve, tmp_path / "pod.png")
    (tmp_path / "diagnosis").mkdir()
    (tmp_path / "diagnosis" / "diagnosis.json").write_text("{}")
    for given in (tmp_path / "diagnosis", tmp_path / "diagnosis" / "diagnosis.json"):
        with pytest.raises(InputError, match=r"wrote its page already: .*diagnosis/report\.html"):
            rt.report(given, tmp_path / "x.html")
    with pytest.raises(InputError, match="expected a twin, a validation"):
        rt.report(3, tmp_path / "x.html")  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A page of each kind that takes no training."""
    folder = tmp_path_factory.mktemp("pages")
    session = rt.lab_session(
        folder / "s.h5",
        protocol="full",
        effects={"object_scatter": 15.0},
        seed=3,
        size=48,
        frames=6,
        only=("filtered_flats", "slab"),
    ).path
    found = rt.diagnose(session, seed=0)
    made = {
        "marks": write_result_page(folder / "marks.html", example_page(), version="1"),
        "diagnosis": rt.report(found, folder / "diagnosis.html"),
        "twin": rt.report(found.twin, folder / "twin.html"),
        "validation": rt.report(rt.validate(found.twin, session), folder / "validation.html"),
        "pod": rt.report(rt.fit_pod(POD_TABLE, link="logit"), folder / "pod.html"),
    }
    described = folder / "products.toml"
    described.write_text(PRODUCTS)
    low, high = (f"kv={kV},power_w=40,exposure_ms=20,filter=Cu:0.05" for kV in (40, 90))
    pairs = rt.generate("virtual_lab", described, low=low, high=high, n=4, seed=1, output=folder / "pairs.h5")
    made["dataset"] = rt.report(pairs, folder / "dataset.html")
    made["static"] = rt.report(found, folder / "static.html", interactive=False)
    return made


@pytest.mark.browser
class TestInChromium:
    @pytest.mark.parametrize("name", ["marks", "diagnosis", "twin", "validation", "pod", "dataset", "static"])
    def test_a_page_fits_asks_nobody_and_draws_its_figures(self, check_page, pages, name: str) -> None:  # type: ignore[no-untyped-def]
        check_page(pages[name], static=name == "static")

    @pytest.mark.skipif(not DEMO.exists(), reason="make demo")
    def test_the_page_of_a_demo_that_was_made_fits_too(self, check_page) -> None:  # type: ignore[no-untyped-def]
        check_page(DEMO)

    def test_the_first_screen_of_a_diagnosis_has_answer_proof_and_next_step(self, open_page, pages) -> None:  # type: ignore[no-untyped-def]
        page = open_page(pages["diagnosis"])
        for part in ("h1", ".answer", "figure >> nth=0", ".next h2"):
            assert page.locator(part).first.bounding_box()["y"] < 900, part
        assert not page.locator("details").first.evaluate("one => one.open")
        page.context.close()

    def test_a_click_sorts_a_table_and_a_click_on_a_point_opens_its_row(self, open_page, pages) -> None:  # type: ignore[no-untyped-def]
        page = open_page(pages["marks"])
        page.evaluate("document.querySelector('details').open = true")
        cells = "Array.from(document.querySelectorAll('table.sorted tbody tr')).map((row) => row.cells[0].innerText)"
        page.locator("th", has_text="value").click()
        assert page.evaluate(cells) == ["b", "c", "a"]
        page.locator("th", has_text="value").click()
        assert page.evaluate(cells) == ["a", "c", "b"]
        if page.locator(".drawn").count():
            page.evaluate("document.querySelector('details').open = false")
            page.evaluate(
                "() => { for (const m of Bokeh.documents[0]._all_models.values()) {"
                " if (m.data && m.data.anchor) { m.selected.indices = [1] } } }"
            )
            page.wait_for_timeout(300)
            assert page.locator("#row-2.chosen").count() == 1
            assert page.evaluate("document.querySelector('details').open")
        page.context.close()
