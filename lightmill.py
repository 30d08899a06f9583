"""What other programs import: ``from lightmill import Renderer``. Everything here lives in ``stages``."""

from stages.inference import LimitWarning, Renderer
from stages.scene_files import load_scene
from stages.scenes.orbit import orbit
from stages.scenes.room import Room
from stages.tonemap import TONE_MAPPERS, to_picture

__all__ = ["LimitWarning", "Renderer", "Room", "TONE_MAPPERS", "load_scene", "orbit", "to_picture"]
