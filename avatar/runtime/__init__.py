"""Avatars played without torch: the bundle's file, and what moves and draws it."""

from avatar.runtime.bundle import AboutAvatar, AvatarBundle, load_bundle
from avatar.runtime.player import AvatarPlayer
from avatar.runtime.splatting import Splatter, WorldSplats

__all__ = ["AboutAvatar", "AvatarBundle", "AvatarPlayer", "Splatter", "WorldSplats", "load_bundle"]
