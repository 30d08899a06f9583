"""RenderFormer's networks, losses and training loop: torch, safetensors and numpy on folders it is given.

Knows no config framework and no store; errors for people are InputErrors that say what was given and what to do.
"""
