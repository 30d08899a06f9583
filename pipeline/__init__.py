"""The engine: numbered stages, each a pure function from artifacts to one artifact, over a content-addressed store.

It knows no mesh, image or tensor. A *system* (see ``pipeline.stage.load_system``) supplies the stages.
"""
