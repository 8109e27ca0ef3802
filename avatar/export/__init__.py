"""What training made, for others: a pose as splats, a student as a bundle."""

from smplxpp.core.lazy import lazy_exports

_EXPORTS = {
    "BundleConfig": "avatar.export.bundle",
    "BundleExtras": "avatar.export.bundle",
    "Splats": "avatar.formats",
    "bundle_file": "avatar.export.open_bundle",
    "export_bundle": "avatar.export.student_export",
    "export_student": "avatar.export.student_export",
    "posed_splats": "avatar.export.posed",
    "read_splat_ply": "avatar.formats",
    "write_bundle": "avatar.export.bundle",
    "write_splat_ply": "avatar.formats",
}
__all__ = [*_EXPORTS]
__getattr__, __dir__ = lazy_exports("avatar.export", _EXPORTS)
