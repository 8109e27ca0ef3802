"""Reports of a capture's check: a page, a sheet of pictures, a summary in the terminal."""

from pipelines.captures.check.report import write_check_report

__all__ = ["write_check_report"]
