"""The guided network: closed forms of the light that a pixel receives, and a small network for what they leave out.

It reads what RenderFormer reads, and guides (``stages.renderformer.guides``): where rays land, and which lights are seen from
there. Before training its image is the closed form; training adds indirect light, soft shadows and rough reflections.
"""
