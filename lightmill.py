"""What other programs import: ``from lightmill import Renderer``. Everything here lives in ``stages``."""

from stages.graphics.tonemap import TONE_MAPPERS, to_picture
from stages.renderformer.inference.orbit import orbit
from stages.renderformer.inference.renderer import LimitWarning, Renderer
from stages.renderformer.inference.room import Room
from stages.renderformer.inference.scene_files import load_scene
from stages.viewer.notebook import view

__all__ = ["LimitWarning", "Renderer", "Room", "TONE_MAPPERS", "load_scene", "orbit", "to_picture", "view"]
