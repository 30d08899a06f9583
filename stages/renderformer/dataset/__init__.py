"""The dataset as others read it: training and evaluation see shards only through this package.

``shards`` finds and decodes samples, ``augment`` makes examples of them, ``loader`` orders and hands out batches,
``encoding`` is a scene's bytes, ``card`` says what is in it.

A batch holds, for B scenes padded to N triangles with V views of H x W pixels (float32 unless said):
    triangles, vertex_normals (B, N, 3, 3); diffuse, specular (B, N, 3); roughness (B, N);
    emission (B, N, 3) radiance; mask (B, N) bool, True = a triangle, False = padding (zeros);
    camera_to_world (B, V, 4, 4); fov_deg (B, V); image (B, V, H, W, 3) linear radiance;
    the AOV layers asked for, (B, V, H, W, 3) or (B, V, H, W); direct is left out when lights are reweighted;
    patch_index (B, N) int32, -1 = constant, else into patches (T, 7, 32, 32) float16 of this batch: both only where
    a scene of the batch has textured triangles;
    guide_* where they were asked for (``stages.renderformer.guides.records``): guide_light_triangles (B, L), -1 where a scene
    has fewer; guide_triangle_seen (B, N, 4, L); guide_bounces (B, N, 2, 16), guide_bounces_weights and guide_vertex, where
    the shards have bounces; guide_hit (B, V, H, W, 4) and the other fields of ViewGuides;
    bundles (B, V, K) int64 where only some ray bundles were drawn: image and guides are then (B, V, K, side^2, ...);
    views (B, V) int64, camera index of each view; ids, B sample ids; damaged, (id, reason) of samples that were skipped.
"""

from stages.renderformer.dataset.augment import (
    Batch,
    Relight,
    collate,
    draw_light_factors,
    expose,
    make_example,
    mirror,
    move,
    rotation_from_vector,
)
from stages.renderformer.dataset.loader import BatchConfig, Batches, Needs, evaluation_samples, prefetch
from stages.renderformer.dataset.shards import DamagedSample, DamagedShard, Sample, ShardDataset, decode_members, decode_sample

__all__ = [
    "Batch",
    "BatchConfig",
    "Batches",
    "DamagedSample",
    "DamagedShard",
    "Needs",
    "Relight",
    "Sample",
    "ShardDataset",
    "collate",
    "decode_members",
    "decode_sample",
    "draw_light_factors",
    "evaluation_samples",
    "expose",
    "make_example",
    "mirror",
    "move",
    "prefetch",
    "rotation_from_vector",
]
