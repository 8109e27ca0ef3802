"""Loose cloth simulated: garments of a template as particles, moved by gravity, air and the body (XPBD)."""

from smplxpp.cloth.driver import ClothDriver, ClothShape, DriverConfig
from smplxpp.cloth.garment import Garment, GarmentConfig, cut_garment
from smplxpp.cloth.model import Fabric, SolverConfig

__all__ = [
    "ClothDriver",
    "ClothShape",
    "DriverConfig",
    "Fabric",
    "Garment",
    "GarmentConfig",
    "SolverConfig",
    "cut_garment",
]
