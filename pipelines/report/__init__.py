"""The report of a run: data model, charts, and one self-contained HTML file."""

from pipelines.report.builder import write_report
from pipelines.report.model import (
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
)

__all__ = [
    "CheckRow",
    "Comparison",
    "Curve",
    "Film",
    "Histogram",
    "KeyNumber",
    "Picture",
    "Report",
    "Section",
    "Table",
    "count_statuses",
    "format_value",
    "worst_status",
    "write_report",
]
