"""Scenes modelled in other tools (glTF, USD) as RenderFormer scenes, and what had to be replaced on the way."""
