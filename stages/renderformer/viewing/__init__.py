"""What the viewer shows of RenderFormer's stages: meshes, scenes with their images, and models at work.

``VIEWS`` is all that leaves this room. Heavy libraries are imported by the action that needs them, so that a store opens at
once.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from stages.graphics.panels import Context, Views
from stages.renderformer.viewing import meshes, models, scenes


def file_panels(context: Context) -> Iterator[Any]:
    """A scene or mesh file: the scene, its mesh in a room, and the model."""
    yield scenes.space(models.file_scene(context), {}, {"file": True}, context.path.name)


VIEWS = Views(
    stages={
        "collect": meshes.collected,
        "remesh": meshes.remeshed,
        "decimate": meshes.decimated,
        "scene": scenes.show,
        "render": scenes.show,
        "shard": scenes.show,
        "train": models.trained,
        "evaluate": scenes.predicted,
        "probe": scenes.predicted,
    },
    actions={
        "checkpoints": models.checkpoints,
        "predict": models.predict,
        "trace": models.trace,
        "compare": models.compare,
        "attention": models.attention,
    },
    suffixes=models.SUFFIXES,
    file=file_panels,
)
