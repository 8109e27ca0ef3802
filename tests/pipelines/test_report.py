"""The report: complete, self-contained, and honest about what it was given."""

import base64
import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from pipelines.report import (
    CheckRow,
    Comparison,
    Curve,
    Film,
    Histogram,
    KeyNumber,
    Picture,
    Report,
    Section,
    Table,
    count_statuses,
    format_value,
    worst_status,
    write_report,
)
from pipelines.report.builder import histogram_statistics, histogram_svg, timings_svg
from pipelines.report.model import Step
from pipelines.report.pictures import embed_pictures
from pipelines.report.sections.evaluation import talking_section
from pipelines.report.words import next_steps, uses_of, verdict_of
from pipelines.runs.layout import TALKING_FILM
from smplxpp.core import Check, InputError
from smplxpp.figures import encode_jpeg, encode_png

VOID = {"meta", "img", "input", "br", "link", "hr"}


class Page(HTMLParser):
    """Collects what the tests look at and that every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.sources, self.ids, self.links, self.tags, self.text = [], [], [], [], [], ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append(tag)
        self.sources += [values[k] for k in ("src",) if k in values]
        self.links += [values["href"]] if "href" in values else []
        self.ids += [values["id"]] if "id" in values else []
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        self.text += data


def checks():
    return tuple(
        CheckRow.of(check, stage="65_validate")
        for check in (
            Check("template to scan, mean", 0.62, "mm", 1, 2, explanation="visible surface"),
            Check("template to scan, p95", 3.4, "mm", 3, 6),
            Check("penetrating vertices", 12, "", 0, 0),
            Check("smallest determinant", float("nan"), "", 0.25, 0.05, higher_is_better=True),
        )
    )


def sample_report():
    image = np.random.default_rng(0).integers(0, 255, (40, 30, 3), dtype=np.uint8)
    scan, labels = Picture("Scan <front>", encode_png(image)), Picture("Labels", encode_jpeg(image))
    errors = np.abs(np.random.default_rng(1).normal(size=2000))
    return Report(
        subject="dancer & co",
        summary="A small report.",
        hero=(scan,),
        key_numbers=(KeyNumber("Template to scan", "0.62 mm", "mean"),),
        checks=checks(),
        seconds={"20_segment": 2.5, "30_clean": 0.5},
        sections=(
            Section("Scan", ("As it came in.",), pictures=(scan,), comparisons=(Comparison("both", scan, labels),)),
            Section("It talks", films=(Film("says <b>", b"\0\0\0\x18ftypisom"),)),
            Section(
                "Errors",
                tables=(Table(("label", "mm", "faces"), (("upper", 0.4567, 20000), ("lower", None, 7)), "labels"),),
                histograms=(Histogram("Scan to template", errors, gates=(("warn", 2.0),)),),
                legend=(("hair", (255, 128, 0)),),
                checks=checks()[:3],
            ),
        ),
        provenance={"Configuration": {"seed": 0, "budgets": {"hair": 2000}}, "Inputs": {"scan": "ab" * 32}},
    )


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    assert write_report(path, sample_report()) == path
    return Page(path.read_text(encoding="utf-8")), path


def test_the_page_is_well_formed_and_needs_nothing_else(page):
    parsed, path = page
    assert parsed.open == []
    assert parsed.sources and all(s.startswith(("data:image/", "data:video/mp4;")) for s in parsed.sources)
    assert all(link.startswith("#") and link[1:] in parsed.ids for link in parsed.links)
    html = path.read_text()
    assert "link" not in parsed.tags and not re.search(r"url\(|@import|https?://", html)


def test_the_page_holds_every_number_and_picture(page):
    parsed, _ = page
    for text in (
        "dancer & co",
        "Scan <front>",
        "0.62 mm",
        "not a number",
        "visible surface",
        "1 pass",
        "1 warn",
        "2 fail",
        "Some checks fail",
        "3.0 s in all",
        "0.457",
        "20,000",
        "budgets.hair",
        "2,000",
        "ab" * 32,
        "2,000 values",
    ):
        assert text in parsed.text, text
    first = Image.open(io.BytesIO(base64.b64decode(parsed.sources[0].split(",", 1)[1])))
    assert first.size == Image.open(io.BytesIO(sample_report().hero[0].data)).size
    assert parsed.tags.count("svg") == 2


@pytest.mark.long
def test_pictures_are_compressed_until_the_page_can_be_mailed():
    x, y = np.meshgrid(np.arange(600), np.arange(900))
    waves = 127 * (1 + np.sin(np.stack([x / 3, y / 5, (x + y) / 7], -1)))
    noise = np.random.default_rng(0).normal(0, 20, waves.shape)
    photograph = Picture("photograph", encode_png(np.clip(waves + noise, 0, 255).astype(np.uint8)))
    head = Picture("head", encode_png(waves[:40, :30].astype(np.uint8)), enlarged=8)
    wide, tight = (embed_pictures([photograph, head], room=room) for room in (10_000_000, 60_000))
    assert len(photograph.data) > 1_000_000 > len(wide[photograph].uri)
    assert sum(len(one.uri) for one in tight.values()) <= 60_000
    # The place on the page is that of the picture and not of its file.
    assert (tight[photograph].width, tight[photograph].height) == (600, 900)
    assert (tight[head].width, tight[head].height) == (240, 320)
    pixels = Image.open(io.BytesIO(base64.b64decode(tight[head].uri.split(",")[1])))
    np.testing.assert_array_equal(np.asarray(pixels.convert("RGB")), waves[:40, :30].astype(np.uint8))


def test_the_page_says_first_what_the_run_can_be_used_for_and_what_to_type(tmp_path):
    def row(name, status, stage, value=1.0):
        return CheckRow(name, value, "dB", status, ">= 22 (fail beyond 17) dB", stage=stage)

    shape = row("template to scan, upper: mean", "fail", "65_validate")
    moves = row("edge stretch p99.9, hard poses", "pass", "65_validate")
    trained = row("novel poses: PSNR of the person", "pass", "90_compensate", 18.8)
    purposes = {use.purpose: use for use in uses_of([shape, moves, trained])}
    assert [use.status for use in purposes.values()] == ["pass", "fail", "warn"]
    assert "held-out views yet" in purposes["show its student in new poses"].words
    measured = row("student, novel poses: PSNR of the person", "warn", "95_evaluate", 18.8)
    uses = uses_of([shape, moves, trained, measured])
    assert "PSNR of the person is 18.8 dB" in {use.purpose: use for use in uses}["show its student in new poses"].words
    said = verdict_of("template", [shape, moves, trained, measured], uses)
    assert said == (
        "This template can be used to pose, animate and export it. With care also to show its student in new poses. "
        "It cannot be relied on to measure the person on it. One check failed."
    )
    # Commands have the paths of the run and are safe to paste.
    run = tmp_path / "a run"
    (run / "05_register").mkdir(parents=True)
    (run / "05_register" / "params.npz").touch()
    steps = next_steps(run, capture=tmp_path / "capture", checks=[shape])
    assert all(f"'{run}" in step.command for step in steps)
    assert f"--params '{run}/05_register/params.npz'" in " ".join(step.command for step in steps)
    assert f"smplxpp train '{run}' --capture {tmp_path}/capture" in [step.command for step in steps]
    page = Page(write_report(tmp_path / "report.html", replace(sample_report(), uses=uses, steps=steps)).read_text())
    assert page.text.index("This template can be used") < page.text.index("0.62 mm") < page.text.index("a click opens")
    assert Step("look at the layers in the browser", f"smplxpp view '{run}'") in steps and "smplxpp view" in page.text


def test_stages_are_folded_and_pictures_come_when_they_are_looked_at(page):
    parsed, path = page
    html = path.read_text()
    assert html.count('<details class="stage"') == 3 + 4
    assert re.findall(r'id="(s\d)" open>', html) == ["s3"]  # the stage with a failed check
    assert html.count("<img ") == html.count('loading="lazy"') + 1  # the enlarged one has no source yet
    assert "Chamfer" not in parsed.text and "99.9" not in parsed.text  # of the glossary what the page uses


def test_markup_in_names_stays_text(tmp_path):
    evil = "'\"><script>alert(1)</script>"
    picture = Picture(evil, encode_png(np.zeros((4, 4, 3), np.uint8)), evil)
    section = Section(
        evil,
        (evil,),
        pictures=(picture,),
        comparisons=(Comparison(evil, picture, picture),),
        tables=(Table((evil, "b"), ((evil, {evil: [evil]}),), evil),),
        histograms=(Histogram(evil, np.arange(9.0), evil, ((evil, 4.0),)),),
        curves=(Curve(evil, {evil: (np.arange(3.0), np.arange(3.0))}, evil, evil),),
        legend=((evil, (1, 2, 3)),),
        checks=(CheckRow(evil, 1.0, evil, "warn", evil, evil, evil),),
    )
    report = Report(
        subject=evil,
        summary=evil,
        hero=(picture,),
        key_numbers=(KeyNumber(evil, evil, evil),),
        checks=(CheckRow(evil, 1.0, evil, "pass", evil, evil, evil), *section.checks),
        seconds={evil: 1.0},
        sections=(section,),
        provenance={evil: {evil: evil}},
        kind=evil,
    )
    html = write_report(tmp_path / "r.html", report).read_text()
    assert "<script>alert" not in html and Page(html).tags.count("script") == 1


def test_an_almost_empty_report_is_a_page(tmp_path):
    parsed = Page(write_report(tmp_path / "r.html", Report(subject="nobody")).read_text())
    assert parsed.open == [] and "No checks were made" in parsed.text


def test_a_report_is_the_same_each_time_and_leaves_no_other_file(tmp_path):
    write_report(tmp_path / "a.html", sample_report())
    write_report(tmp_path / "b.html", sample_report())
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"a.html", "b.html"}


def test_check_rows_come_from_checks_and_from_manifests_alike():
    check = Check("p95", 3.4, "mm", 3, 6, explanation="why")
    assert CheckRow.of(check, stage="x") == CheckRow.of(check.as_dict(), stage="x")
    assert CheckRow.of({"name": "n", "value": None, "status": "fail"}).shown == "not a number"
    assert count_statuses(checks()) == {"fail": 2, "warn": 1, "pass": 1}
    assert worst_status(checks()) == "fail" and worst_status(checks()[:2]) == "warn" and worst_status(()) == "pass"
    for record in ({"value": 1}, {"name": "n", "status": "great"}):
        with pytest.raises(InputError):
            CheckRow.of(record)


def test_pictures_and_tables_are_checked():
    with pytest.raises(InputError, match="PNG, JPEG or WebP"):
        embed_pictures([Picture("x", b"GIF89a")], room=100)
    with pytest.raises(InputError, match="2 cells"):
        Table(("a", "b"), ((1,),))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.61666, "0.617"),
        (12, "12"),
        (20908, "20,908"),
        (3.0, "3"),
        (10.0, "10"),
        (99.94, "99.9"),
        (0, "0"),
        (0.0, "0"),
        (123.456, "123.5"),
        (12345.6, "12,346"),
        (2e-16, "2.00e-16"),
        (True, "yes"),
        (None, "-"),
        ("text", "text"),
        (float("nan"), "not a number"),
        (float("-inf"), "-∞"),
        (-0.05, "-0.05"),
        (np.float32(1.5), "1.5"),
        (np.int64(7), "7"),
    ],
)
def test_numbers_are_written_for_readers(value, text):
    assert format_value(value) == text


def bars(svg):
    pattern = r'class="bar[^"]*" x="([\d.]+)" y="([\d.]+)" width="[\d.]+" height="([\d.]+)"'
    return [tuple(map(float, found)) for found in re.findall(pattern, svg)]


def test_histogram_bars_are_the_distribution():
    values = np.concatenate([np.full(75, 0.5), np.full(25, 3.5)])
    drawn = bars(histogram_svg(Histogram("h", values, upper=4.0)))
    assert len(drawn) == 2
    assert drawn[0][2] == pytest.approx(3 * drawn[1][2], rel=1e-3)
    assert drawn[0][1] + drawn[0][2] == pytest.approx(drawn[1][1] + drawn[1][2], abs=0.02)  # one base line


def test_histograms_say_what_they_leave_out():
    values = np.array([0.1, 0.2, 0.3, 50.0, np.nan])
    svg = histogram_svg(Histogram("h", values, upper=1.0))
    assert "25 % exceed the axis" in svg and 'class="bar beyond"' in svg
    assert histogram_statistics(values)["not_finite"] == 1
    assert histogram_statistics(values)["max"] == 50.0
    with pytest.raises(InputError, match="histogram"):
        histogram_svg(Histogram("h", np.array([np.nan])))


def test_signed_values_are_drawn_about_zero_and_constant_ones_at_all():
    assert ">0</text>" in histogram_svg(Histogram("s", np.linspace(-2, 1, 100)))
    assert len(bars(histogram_svg(Histogram("zero", np.zeros(10))))) == 1


def test_a_gate_is_drawn_where_it_can_be_seen():
    values = np.linspace(0, 1, 1000)
    assert 'class="gate"' in histogram_svg(Histogram("h", values, gates=(("g", 2.0),)))
    assert 'class="gate"' not in histogram_svg(Histogram("h", values, gates=(("g", 500.0),)))


def test_timings_are_in_proportion():
    widths = [float(w) for w in re.findall(r'class="bar"[^>]* width="([\d.]+)"', timings_svg({"a": 4.0, "b": 1.0}))]
    assert widths[0] == pytest.approx(4 * widths[1], rel=1e-2)
    assert timings_svg({}) == ""


def test_what_needs_a_look_says_which_stage_found_it(page):
    wanted = [check for check in sample_report().checks if check.status != "pass"]
    shown = page[1].read_text().split("What needs a look")[1].split("</section>")[0]
    assert wanted and shown.count("<small>65_validate") == len(wanted)


def test_a_film_of_the_run_is_in_its_report_if_it_is_small(tmp_path):
    assert talking_section(tmp_path) == ()
    film = b"\0\0\0\x18ftypisom" + bytes(100)
    (tmp_path / TALKING_FILM).write_bytes(film)
    (section,) = talking_section(tmp_path)
    page = write_report(tmp_path / "report.html", Report("a run", sections=(section,))).read_text()
    assert base64.b64encode(film).decode() in page and "<video controls" in page
    (tmp_path / TALKING_FILM).write_bytes(film + bytes(3_000_000))
    assert talking_section(tmp_path) == ()
    with pytest.raises(InputError, match="MP4"):
        Film("no film", b"RIFF0000AVI ")
