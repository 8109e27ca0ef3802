"""Segmentation of a scan: label files, label maps, or the fitted body in, a label with its confidence a face out."""

from smplxpp.segment.by_body import ByBodyConfig, label_by_body
from smplxpp.segment.by_body_confidence import UNSURE
from smplxpp.segment.corrections import BoxCorrection, Corrections, FaceCorrection, StrokeCorrection
from smplxpp.segment.label_files import holds_labels, labels_from_colors, read_label_map, read_labels
from smplxpp.segment.label_sets import LABEL_SETS, LabelSet
from smplxpp.segment.labels import find_label_set, map_labels
from smplxpp.segment.segment import SegmentConfig, SegmentedScan, segment_scan
from smplxpp.segment.votes import AgreedVotes, vote_in_agreement, vote_on_faces

__all__ = [
    "AgreedVotes",
    "BoxCorrection",
    "Corrections",
    "FaceCorrection",
    "LABEL_SETS",
    "ByBodyConfig",
    "LabelSet",
    "SegmentConfig",
    "SegmentedScan",
    "StrokeCorrection",
    "UNSURE",
    "find_label_set",
    "holds_labels",
    "label_by_body",
    "labels_from_colors",
    "map_labels",
    "read_label_map",
    "read_labels",
    "segment_scan",
    "vote_in_agreement",
    "vote_on_faces",
]
