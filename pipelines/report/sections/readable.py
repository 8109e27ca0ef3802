"""The report goes on where what a stage has left cannot be read: a line says so in the place of its section."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from pipelines.report.charts import curve_svg, histogram_svg
from pipelines.report.model import CheckRow, KeyNumber, Section
from pipelines.runs.artefacts import values_of
from pipelines.runs.stage import StageRecord
from smplxpp.core.errors import GeometryWarning, InputError


def readable(record: StageRecord, title: str, make: Callable[[], Section]) -> Section:
    """The section that `make` takes from a stage's files, or one that says why it cannot.

    A stage that ran in this very call wrote its files just now: what is wrong with them is ours, and an error.
    """
    try:
        with values_of(record), np.errstate(over="raise", divide="raise", invalid="raise"):
            section = make()
            for curve in section.curves:
                curve_svg(curve)
            for histogram in section.histograms:
                histogram_svg(histogram)
            return section
    except InputError as error:
        if record.ran:
            raise
        words = f"{record.folder.name} cannot be read: {error}"
        warnings.warn(f"report: {words}", GeometryWarning, stacklevel=2)
        checks = tuple(CheckRow.of(check, stage=record.folder.name) for check in record.manifest["checks"])
        return Section(title=title, text=(words,), checks=checks)


def readable_numbers(record: StageRecord, make: Callable[[], tuple[KeyNumber, ...]]) -> tuple[KeyNumber, ...]:
    """The numbers for the head of the report that `make` takes from a stage's manifest; none where it cannot."""
    try:
        with values_of(record):
            return make()
    except InputError as error:
        if record.ran:
            raise
        warnings.warn(f"report: {record.folder.name} cannot be read: {error}", GeometryWarning, stacklevel=2)
        return ()
