"""`smplxpp check`: a verdict on any mesh, rigged file or template, with each fault's region in a coloured PLY."""

from __future__ import annotations

import json as json_format
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from pipelines.commands.options import OptionalPath
from pipelines.commands.templates import load_params_for, load_run_template
from smplxpp.build.mesh_verdict import check_mesh
from smplxpp.core import InputError, SkinWeights, read_mesh, write_ply
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.template.template import Template


@dataclass(frozen=True)
class CheckMesh:
    """Options of `smplxpp check`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MESH|TEMPLATE|RUN")]
    """A mesh in any format that is read, rigged or not, a template (`smplxpp.npz`), or the folder of a run."""
    scan: OptionalPath = None
    """A scan to compare with, in the pose of `params` for a template."""
    params: OptionalPath = None
    """Body parameters of that pose."""
    weights: OptionalPath = None
    """Skin weights of a mesh, `.npz` or `.json` of `SkinWeights.save`."""
    units: Literal["m", "cm", "mm"] = "m"
    """Units of a mesh and of the scan."""
    out: OptionalPath = None
    """Folder for `check.json` and `faults.ply`, the mesh with its faults in colour."""
    strict: bool = False
    """Exit with status 1 when a check fails."""
    json: bool = False
    """Print the result as JSON."""

    def run(self) -> dict[str, Any]:
        """Check, print a table unless `json`, write `out`.

        Raises:
            InputError: a file that is not read, or options that do not fit it.
        """
        subject: Path | Template = self.path
        if self.path.is_dir():
            subject = load_run_template(self.path)
        elif self.path.suffix.lower() == ".npz":
            subject = Template.load(self.path)
        params = None
        if self.params is not None:
            if not isinstance(subject, Template):
                raise InputError("option params", expected="a template or a run", received=f"the mesh {self.path.name}")
            params = load_params_for(subject, self.params)
        found = check_mesh(
            subject,
            weights=None if self.weights is None else SkinWeights.load(self.weights)[0],
            scan=None if self.scan is None else read_mesh(self.scan).mesh,
            params=params,
            unit=self.units,
        )
        report = {"path": str(self.path), **found.as_dict()}
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
            atomic_write_text(self.out / "check.json", json_format.dumps(report, indent=1) + "\n")
            write_ply(self.out / "faults.ply", found.mesh, vertex_colors=found.colors())
        if not self.json:
            _print(report, Console(), self.out)
        return {**report, "exit_status": int(self.strict and report["verdict"] == "fail")}


def _print(report: dict[str, Any], console: Console, out: Path | None) -> None:
    """Print the faults, borders, which clothes have, and the verdict."""
    styles = {"pass": "green", "warn": "yellow", "fail": "red"}
    size = f"{report['vertices']:,} vertices, {report['faces']:,} faces"
    table = Table(title=f"{report['path']}: {size}", title_justify="left")
    for column in ("part", "finding", "value", "limit", ""):
        table.add_column(column, justify="right" if column == "value" else "left", overflow="fold")
    faults = [row for row in report["checks"] if row["status"] != "pass"]
    for row in faults:
        value = f"{row['value']:.4g} {row['unit']}".strip()
        table.add_row(row["part"], row["name"], value, row["gate"], row["status"], style=styles[row["status"]])
    if faults:
        console.print(table)
    if "not_posed" in report.get("rig", {}):
        console.print(f"no stress poses: {report['rig']['not_posed']}", style="yellow", markup=False)
    for name, of in report.get("quality", {}).items():
        if of["border_loops"] or of["nonmanifold_vertices"]:
            line = f"{name}: {of['components']} pieces, {of['border_loops']} borders"
            line += f", the longest {max(of['border_lengths_mm']):,.0f} mm" if of["border_loops"] else ""
            line += f", touching at {n} vertices" if (n := of["nonmanifold_vertices"]) else ""
            console.print(line, markup=False, highlight=False)
    verdict, where = report["verdict"], f"; faults in colour: {out / 'faults.ply'}" if out else ""
    passed = f"{len(report['checks']) - len(faults)} of {len(report['checks'])} checks pass"
    console.print(f"[{styles[verdict]}]{verdict}[/]: {passed}; {size}{where}", soft_wrap=True)
