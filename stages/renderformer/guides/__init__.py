"""Guides: what ray casting alone says about a scene and its views, for networks that read more than triangles.

No light transport is in them and no colour: where the rays of a pixel land, where its reflections land, and which lights are
seen from there. So they stay exact where lights change, and where the scene is moved or mirrored. ``casting`` makes them,
``records`` says what they are and stores them.
"""

from stages.renderformer.guides.casting import GuideCaster
from stages.renderformer.guides.records import SceneGuides, ViewGuides, guide_member

__all__ = ["GuideCaster", "SceneGuides", "ViewGuides", "guide_member"]
