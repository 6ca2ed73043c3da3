"""Pages of a report: rendered blocks, their style, and figures as files."""

import base64
import gzip
import json
import math
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from browser import chromium, opened
from hypothesis import given
from hypothesis import strategies as st
from plotly.offline import get_plotlyjs

from omnibench.errors import DataError
from omnibench.report import blocks, numbers
from omnibench.report.blocks import Choice, Details, Document, Figure, FigureGrid, LegendItem, Section
from omnibench.report.figure_files import browser, named_grids, write_figures
from omnibench.report.figures import area, arrows, coordinates, joined, line, marks, path
from omnibench.report.render import render, write_document
from omnibench.report.style import PALETTE, REFERENCE, THEORETICAL, colours, logarithmic, plan, plot, wrapped
from omnibench.words import noun_for, plural

HOSTILE = "</script><script>alert('x')</script><img src=x onerror=alert(1)> & \"quoted\""


class Reader(HTMLParser):
    """Counts tags and keeps the text outside scripts and styles."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self.text = ""
        self._inside: list[str] = []
        self._script = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._inside.append(tag)
            self._script = dict(attrs).get("id") or ""

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self._inside.pop()

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self.text += data
        elif self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data


def document(*parts: blocks.Block, title: str = "A report") -> blocks.Document:
    return blocks.Document(
        title, "of something", (blocks.Section("part", "A part", parts),), (blocks.Badge("SIMULATED DATA", "warning"),)
    )


def grid(name: str = "curve", values: tuple[float, ...] = (1.0, 2.0)) -> blocks.FigureGrid:
    curve = go.Scatter(x=[0, 1], y=list(values), name=name, legendgroup="one")
    return blocks.FigureGrid((blocks.Figure(name, plot(curve), name),), (blocks.LegendItem("one", name, "#0072b2"),))


def every_block(words: str) -> tuple[blocks.Block, ...]:
    """One block of each kind, all of them made of the same words."""
    table = blocks.Table(
        words,
        (blocks.Column(words, words),),
        (blocks.Row((blocks.Cell(words, words, "#0072b2"),)), blocks.Row((blocks.Cell(words),), "group")),
    )
    inner: tuple[blocks.Block, ...] = (
        blocks.Paragraph(words),
        blocks.Callout(words, (words,)),
        blocks.Facts((blocks.Fact(words, words, words),)),
        table,
    )
    return (*inner, blocks.Code(words, words), blocks.Details(words, inner), grid(words))


def test_hostile_words_stay_words_in_every_block() -> None:
    plain, hostile = (Reader(render(document(*every_block(w), title=w))) for w in ("plain", HOSTILE))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert hostile.text.count(HOSTILE) >= 15


def test_hostile_words_come_back_whole_from_a_plots_data() -> None:
    reader = Reader(render(document(grid(HOSTILE))))
    assert json.loads(reader.scripts["part-1-1"])["data"][0]["name"] == HOSTILE


def test_the_file_loads_nothing_from_elsewhere() -> None:
    reader = Reader(render(document(*every_block("plain"))))
    sources = [value for _, attrs in reader.tags for name, value in attrs.items() if name in ("src", "href")]
    assert all(value is not None and value.startswith(("#", "data:")) for value in sources)
    policies = [attrs["content"] for _, attrs in reader.tags if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policies
    assert "default-src 'none'" in (policies[0] or "")


def library(*grids: blocks.FigureGrid) -> str:
    """The script that a page with these figures draws them with."""
    return gzip.decompress(base64.b64decode(Reader(render(document(*grids))).scripts["library"])).decode()


def test_a_page_holds_once_what_draws_its_plots_and_no_more_than_it_needs() -> None:
    assert len(re.findall(r"plotly\.js \(cartesian - minified\) v\d", library(grid(), grid()))) == 1
    assert Reader(render(document(blocks.Paragraph("text")))).scripts.get("library", "").strip() == ""


def test_the_bundle_is_that_of_the_installed_plotly() -> None:
    drawn, whole = (re.search(r"v(\d+)\.\d+\.\d+", text)[1] for text in (library(grid())[:200], get_plotlyjs()[:200]))
    assert drawn == whole


def test_every_plot_has_data_of_its_own() -> None:
    reader = Reader(render(document(grid("a"), blocks.Details("more", (grid("b"),)))))
    wanted = [attrs["data-source"] for tag, attrs in reader.tags if tag == "div" and "data-source" in attrs]
    assert len(wanted) == len(set(wanted)) == 2
    assert set(wanted) == set(reader.scripts) - {"library"}


def test_missing_values_of_a_plot_are_valid_json() -> None:
    reader = Reader(render(document(grid(values=(np.nan, np.inf)))))
    assert json.loads(reader.scripts["part-1-1"])["data"][0]["y"] == [None, None]


def test_the_table_of_contents_leads_to_every_section() -> None:
    inner = blocks.Section("inner", "Inner", (blocks.Paragraph("text"),))
    reader = Reader(render(blocks.Document("t", "s", (blocks.Section("outer", "Outer", (), (inner,)),))))
    links = [attrs["href"] for tag, attrs in reader.tags if tag == "a"]
    assert links == ["#outer", "#inner"]
    assert {attrs.get("id") for tag, attrs in reader.tags if tag == "section"} == {"outer", "inner"}


def test_a_report_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match=r"report\.html: cannot be written"):
        write_document(document(blocks.Paragraph("text")), tmp_path / "file" / "report.html")


def test_a_written_report_is_what_was_rendered(tmp_path: Path) -> None:
    write_document(document(blocks.Paragraph("text")), tmp_path / "deep" / "report.html")
    assert (tmp_path / "deep" / "report.html").read_text(encoding="utf-8") == render(document(blocks.Paragraph("text")))


# Colours, axes and traces of plots, and numbers as a person reads them.


def test_an_entry_gets_the_colour_that_it_wants_and_the_second_to_want_it_another() -> None:
    given_styles = colours({"first": "#0072b2", "second": "#0072b2"})
    assert given_styles["first"] == ("#0072b2", "solid")
    assert given_styles["second"] != given_styles["first"]


@given(st.lists(st.sampled_from([*PALETTE, None]), max_size=30))
def test_up_to_thirty_entries_look_different(wanted: list[str | None]) -> None:
    styles = colours({f"entry {index}": colour for index, colour in enumerate(wanted)})
    assert len(set(styles.values())) == len(wanted)
    assert not {REFERENCE, THEORETICAL} & {colour for colour, _ in styles.values()}


@given(st.floats(min_value=-12, max_value=6), st.floats(min_value=0, max_value=14))
def test_a_logarithmic_axis_holds_its_data_and_has_labels(low: float, decades: float) -> None:
    figure = plot()
    logarithmic(figure, "y", 10**low, 10 ** (low + decades))
    bottom, top = figure.layout.yaxis.range
    assert bottom <= low
    assert low + decades <= top
    ticks = [math.log10(tick) for tick in figure.layout.yaxis.tickvals]
    assert len(ticks) == len(figure.layout.yaxis.ticktext)
    assert sum(bottom <= tick <= top for tick in ticks) <= 10
    if decades >= 1:
        assert any(bottom <= tick <= top for tick in ticks)


def test_a_path_far_from_the_origin_is_drawn_from_a_round_value_that_its_axis_and_its_hover_text_name() -> None:
    poses = np.array([[500_000.25, 4_600_000.5], [500_001.25, 4_600_001.0]])
    item = LegendItem("a", "a path", "#111111")
    trace = path(item, poses, 2.0)
    for _ in range(2):  # a trace may be in several figures
        figure = plan(trace, window=np.array([[499_999.0, 500_002.0], [4_599_999.0, 4_600_002.0]]))
        assert figure.data[0].x == pytest.approx([0.25, 1.25])
        assert figure.data[0].y == pytest.approx([0.5, 1.0])
        assert figure.layout.xaxis.title.text == "x − 500,000 (m)"
        assert figure.layout.yaxis.title.text == "y − 4,600,000 (m)"
        assert figure.layout.xaxis.range == (-1.0, 2.0)
        assert "y − 4,600,000 = %{y:.3f} m" in figure.data[0].hovertemplate


def test_long_labels_break_after_their_words_and_within_a_word_that_is_too_long() -> None:
    assert wrapped("held-out: square_a90_turn+360_v0.2_r0.8x1") == "held-out: square_a90_\nturn+360_v0.2_r0.8x1"
    assert wrapped("abcdefgh", 3) == "abc\ndef\ngh"
    assert wrapped("design values") == "design values"


def test_a_path_near_the_origin_is_drawn_as_it_is() -> None:
    figure = plan(path(LegendItem("a", "a path", "#111111"), np.array([[90.0, 2.0], [91.0, 3.0]]), 2.0))
    assert (figure.data[0].x, figure.layout.xaxis.title.text) == ((90.0, 91.0), "x (m)")


ITEM = LegendItem("key", "a <name>", "#0072b2", "dot", "square-open")


def test_a_line_breaks_at_nan_and_between_joined_paths() -> None:
    drawn = line(ITEM, 2.0, *joined([np.zeros((2, 2)), np.ones((1, 2))]).T)
    assert drawn.x == (0.0, 0.0, None, 1.0)
    assert coordinates([math.nan, 1.2345678, 3.0]) == [None, 1.2346, 3.0]


def test_coordinates_are_as_fine_far_from_the_origin_as_near_it() -> None:
    assert coordinates([500000.0, 500000.12345, 500005.0]) == [500000.0, 500000.12345, 500005.0]
    assert coordinates([-500000.0, -500000.1, -500005.0]) == [-500000.0, -500000.1, -500005.0]
    assert coordinates([1e-9, 1.23456789e-6, 1.0]) == [1e-9, 1.2346e-6, 1.0]  # of a logarithmic axis
    assert coordinates([1234.5678] * 2) == [1234.5678] * 2


def test_a_trace_has_the_style_of_its_item_and_is_switched_by_it() -> None:
    drawn = line(ITEM, 2.0, [0.0], [1.0])
    assert (drawn.line.color, drawn.line.dash, drawn.line.width) == ("#0072b2", "dot", 2.0)
    assert marks(ITEM, 5, [0.0], [1.0]).marker.symbol == "square-open"
    assert {trace.legendgroup for trace in (drawn, area("key", "red", [0.0], [1.0]))} == {"key"}


def test_what_has_nothing_to_show_is_not_hovered_over() -> None:
    assert line(ITEM, 2.0, [0.0], [1.0]).hoverinfo == "skip"
    assert marks(ITEM, 5, [0.0], [1.0], hover="%{text}", words=["here"]).hovertemplate == "%{text}<extra></extra>"


def test_names_of_categories_and_words_cannot_be_markup() -> None:
    drawn = marks(ITEM, 5, [1.0], ["<b> & c"], hover="%{text}", words=["one\n<two>"])
    assert drawn.y == ("&lt;b&gt; &amp; c",)
    assert drawn.text == ("one<br>&lt;two&gt;",)


def test_arrows_point_from_start_to_tip() -> None:
    starts = np.zeros((3, 2))
    shafts, heads = arrows(ITEM, starts, np.array([[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]), ["up", "right", "left"])
    assert shafts.y == (0.0, 1.0, None, 0.0, 0.0, None, 0.0, 0.0)
    assert heads.marker.angle == (0.0, 90.0, -90.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.12345, "0.1235"),
        (-0.5, "−0.5000"),
        (12345.0, "12,345.0000"),
        (-1e-9, "0.0000"),
        (None, numbers.NOTHING),
        (math.nan, numbers.NOTHING),
        (math.inf, "∞"),
    ],
)
def test_a_fixed_number_has_its_decimals_and_a_true_minus(value: float | None, text: str) -> None:
    assert numbers.fixed(value, 4) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.021434, "0.0214"),
        (2.04e-8, "2.04 × 10⁻⁸"),
        (9.996e-8, "1.00 × 10⁻⁷"),
        (1234567.0, "1.23 × 10⁶"),
        (637.0, "637"),
    ],
)
def test_significant_digits_use_powers_of_ten_where_zeros_would_be_counted(value: float, text: str) -> None:
    assert numbers.significant(value, 3) == text


@given(st.floats(min_value=-1e12, max_value=1e12, allow_nan=False).filter(lambda value: abs(value) > 1e-300))
def test_significant_digits_read_back_to_the_same_value(value: float) -> None:
    words = numbers.significant(value, 4).replace("−", "-").replace(",", "")
    if " × 10" in words:
        mantissa, exponent = words.split(" × 10")
        power = exponent.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
        words = f"{mantissa}e{power}"
    assert float(words) == pytest.approx(value, rel=6e-4)


@given(st.floats(min_value=1e-6, max_value=1e6))
def test_decimals_show_the_digits_that_were_asked_for(value: float) -> None:
    assert float(numbers.fixed(value, numbers.decimals_for(value, 3)).replace(",", "")) == pytest.approx(
        value, rel=6e-3
    )


@pytest.mark.parametrize(("value", "text"), [(5e-5, "< 1 ms"), (0.0823, "82 ms"), (26.54, "26.5 s"), (637.2, "637 s")])
def test_a_duration_has_a_unit_that_suits_it(value: float, text: str) -> None:
    assert numbers.seconds(value) == text


def test_a_listing_ends_with_and_and_counts_what_it_leaves_out() -> None:
    assert numbers.listing(["a"]) == "a"
    assert numbers.listing(["a", "b", "c"]) == "a, b and c"
    assert numbers.listing(["a", "b", "c", "d"], limit=2) == "a, b and 2 more"
    assert numbers.listing(["a", "b", "c"], last="or") == "a, b or c"


def test_sentences_of_the_terminal_get_arrows_minus_and_degree_signs() -> None:
    words = "held out: 52 mm -> 14 mm, 4.4 deg -> 1.0 deg (95 % interval -3.2 to 7.3 %); run-01, turn-360"
    assert (
        numbers.typeset(words) == "held out: 52 mm → 14 mm, 4.4° → 1.0° (95 % interval −3.2 to 7.3 %); run-01, turn-360"
    )


def test_the_degree_sign_alone_follows_without_a_space() -> None:
    assert [numbers.with_unit("3", unit) for unit in ("mm", "°", "°/s", "")] == ["3 mm", "3°", "3°/s", "3"]


def test_plurals_are_english() -> None:
    assert [plural(1, "run"), plural(2, "run"), plural(180, "trajectory")] == ["1 run", "2 runs", "180 trajectories"]
    assert [noun_for(1, "run"), noun_for(2000, "run")] == ["run", "runs"]
    assert [plural(1, "simulated trajectory"), plural(0, "ray")] == ["1 simulated trajectory", "0 rays"]


def test_powers_of_ten_are_set_as_such() -> None:
    assert [numbers.power_of_ten(exponent) for exponent in (-10, -1, 0, 3, 4)] == ["10⁻¹⁰", "0.1", "1", "1,000", "10⁴"]


# Figures as files: their names, their number, and one clear line where nothing can draw them.


def grid_of(*titles: str, name: str = "") -> FigureGrid:
    curve = go.Scatter(x=[0, 1], y=[1, 2], legendgroup="one")
    figures = tuple(Figure(title, plot(curve, x_title="x (m)"), title, 200) for title in titles)
    return FigureGrid(figures, (LegendItem("one", "a < b & c", "#0072b2", "dash"),), 2, "", name)


def pictured() -> Document:
    runs = Choice("Run", {"(0.2 m/s, −0.35 rad/s), run-1": (grid_of("Wheel rates"),)})
    folded = Details("More", (grid_of("a", "b"),))
    answer = Section("answer", "Answer", (grid_of("x", name="paths-before-after"),))
    return Document("A report", "", (answer, Section("w", "Wheels", (runs, folded))))


def test_figures_are_named_after_what_stands_above_them() -> None:
    names = list(named_grids(pictured()))
    assert names == ["paths-before-after", "wheels-0.2-m-s-0.35-rad-s-run-1-wheel-rates", "wheels-more"]


def test_figures_of_one_name_are_numbered() -> None:
    twice = Document(
        "A report", "", (Section("a", "Answer", (grid_of("x", name="paths"), grid_of("x", name="paths"))),)
    )
    assert list(named_grids(twice)) == ["paths", "paths-2"]


def test_every_figure_is_written_as_svg_and_png_with_titles_and_legend(tmp_path: Path) -> None:
    chromium()
    names = write_figures(pictured(), tmp_path / "figures")
    assert len(names) == 3
    assert sorted(file.name for file in (tmp_path / "figures").iterdir()) == sorted(
        f"{name}.{ending}" for name in names for ending in ("svg", "png")
    )
    picture = (tmp_path / "figures" / "wheels-more.svg").read_text(encoding="utf-8")
    assert picture.startswith("<svg")
    assert picture.count('class="main-svg"') >= 2
    assert "a &lt; b &amp; c" in picture
    assert (tmp_path / "figures" / "wheels-more.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.slow
def test_a_browser_sets_notes_smaller_than_text_and_both_smaller_than_titles_on_paper_too(tmp_path: Path) -> None:
    texts = (blocks.Paragraph("text"), blocks.Paragraph("note", "note"))
    html = render(Document("A report", "", (Section("a", "Answer", texts),)))
    measure = """<script>
    const size = (selector) => parseFloat(getComputedStyle(document.querySelector(selector)).fontSize);
    document.body.dataset.sizes = ["p.note", "p.plain", "h2", "h1"].map(size).join(" ");</script>"""
    for name, page in (("screen", html), ("paper", html.replace("@media print", "@media all"))):
        file = tmp_path / f"{name}.html"
        file.write_text(page.replace("</body>", f"{measure}</body>"), encoding="utf-8")
        drawn, _ = opened(file)
        found = re.search(r'data-sizes="([^"]*)"', drawn)
        assert found, drawn[-500:]
        sizes = [float(each) for each in found.group(1).split()]
        assert sizes == sorted(set(sizes)), name


@pytest.mark.slow
def test_a_figure_of_a_megabyte_is_written(tmp_path: Path) -> None:
    chromium()
    dots = go.Scatter(x=list(range(6000)), y=[1] * 6000, mode="markers")
    grids = (FigureGrid((Figure("many dots", plot(dots), "many dots", 200),), (), 1, "", "dots"),)
    assert write_figures(Document("A report", "", (Section("a", "Answer", grids),)), tmp_path / "figures") == ["dots"]
    assert (tmp_path / "figures" / "dots.svg").stat().st_size > 1e6


def test_without_a_browser_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.setattr(Path, "exists", lambda _: False)
    with pytest.raises(DataError, match="--figures: no Chromium or Chrome on this machine"):
        browser()
