"""The shape of a RenderFormer network, in the released ``config.json``'s own field names.

One flat, frozen dataclass whose defaults are the released base model (205,173,391 stored numbers). Every variant of the
paper's table 1 is a combination of these fields; a value that this code does not compute is refused by name, so a
checkpoint never loads into a network that means something else.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

from model.errors import InputError

# Fields of the released format that have one supported value. They are kept so that folders are written back complete.
FIXED: dict[str, Any] = {
    "activation": "swiglu",
    "bias": False,
    "dropout": 0.0,
    "include_alpha": False,
    "norm_first": True,
    "norm_type": "rms_norm",
    "patch_size": 8,
    "qk_norm": True,
    "rope_type": "triangle",
    "texture_encoder_norm_type": "rms_norm",
    "use_ldr": False,
    "use_vn_encoder": True,
    "vdir_num_freqs": 0,
    "vdir_pe_type": "nerf",
    "view_indep_qk_norm": True,
    "vn_encoder_norm_type": "rms_norm",
}


KINDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", tuple: "a list of whole numbers"}


def check_types(config: type, data: dict[str, Any], where: str) -> None:
    """InputError where a value of a ``config.json`` is of another type than that field's default.

    A field without a plain default is passed over; one whose default is None takes a list of whole numbers as well.
    """
    for entry in dataclasses.fields(config):
        if entry.default is dataclasses.MISSING or entry.name in FIXED:
            continue
        kind, value = tuple if entry.default is None else type(entry.default), data[entry.name]
        if value is None and entry.default is None:
            continue
        fits = (
            isinstance(value, list | tuple) and all(type(item) is int for item in value)
            if kind is tuple
            else (type(value) is kind or (kind is float and type(value) is int))
        )
        if not fits:
            raise InputError(f"{where}: {entry.name} is {str(value)[:60]!r}, expected {KINDS[kind]}")


@dataclass(frozen=True)
class ModelConfig:
    """Widths, depths and switches of both stages. Unit of every ``*_dim`` is channels."""

    # View-independent stage (section 3.1)
    latent_dim: int = 768
    num_layers: int = 12
    num_heads: int = 6
    dim_feedforward: int = 3072
    num_register_tokens: int = 16
    texture_channels: int = 13  # 13: diffuse, specular, roughness, normal, emission; 10: the paper's, without the normal
    texture_encode_patch_size: int = 32  # P of the P x P patch; 1 for one vector per triangle
    vn_pe_num_freqs: int = 6
    pe_type: str = "rope"  # rope | nerf (the ablation of section 4.1)
    vertex_pe_num_freqs: int = 12  # rope: n/2 frequencies per coordinate; nerf: n of them
    rope_double_max_freq: bool = False  # highest frequency n - 1 instead of n/2 - 1
    # View-dependent stage (section 3.2)
    view_transformer_latent_dim: int = 768
    view_transformer_n_layers: int = 6
    view_transformer_n_heads: int = 6
    view_transformer_ffn_hidden_dim: int = 3072
    view_transformer_include_self_attn: bool = True
    view_transformer_use_swin_attn: bool = False
    turn_to_cam_coord: bool = True  # False: the view stage stays in world space
    use_dpt_decoder: bool = True  # False: one linear layer per patch
    dpt_features: int = 128
    dpt_out_channels: tuple[int, ...] = (96, 192, 384, 768)
    dpt_out_layers: tuple[int, ...] | None = None  # None: the last four
    # One supported value each, see FIXED
    activation: str = "swiglu"
    bias: bool = False
    dropout: float = 0.0
    include_alpha: bool = False
    norm_first: bool = True
    norm_type: str = "rms_norm"
    patch_size: int = 8
    qk_norm: bool = True
    rope_type: str = "triangle"
    texture_encoder_norm_type: str = "rms_norm"
    use_ldr: bool = False
    use_vn_encoder: bool = True
    vdir_num_freqs: int = 0
    vdir_pe_type: str = "nerf"
    view_indep_qk_norm: bool = True
    vn_encoder_norm_type: str = "rms_norm"

    def __post_init__(self) -> None:
        for name, value in FIXED.items():
            given = getattr(self, name)
            if type(given) is bool is not type(value) or given != value:
                raise InputError(f"model.{name}={given!r} is not supported: only {value!r} is")
        for name in ("latent_dim", "num_heads", "dim_feedforward", "texture_encode_patch_size", "vn_pe_num_freqs",
                     "vertex_pe_num_freqs", "view_transformer_latent_dim", "view_transformer_n_layers",
                     "view_transformer_n_heads", "view_transformer_ffn_hidden_dim", "dpt_features"):  # fmt: skip
            if getattr(self, name) < 1:
                raise InputError(f"model.{name}={getattr(self, name)} must be at least 1")
        for name in ("num_layers", "num_register_tokens"):
            if getattr(self, name) < 0:
                raise InputError(f"model.{name}={getattr(self, name)} must not be negative")
        if self.pe_type not in ("rope", "nerf"):
            raise InputError(f"model.pe_type={self.pe_type!r} is not supported: rope or nerf")
        if self.texture_channels not in (10, 13):
            raise InputError(f"model.texture_channels={self.texture_channels} is not supported: 13, or 10 (no normal)")
        if self.view_transformer_latent_dim != self.latent_dim:
            raise InputError(
                f"model.view_transformer_latent_dim={self.view_transformer_latent_dim} must equal "
                f"model.latent_dim={self.latent_dim}: both stages share the triangle tokens"
            )
        for stage, heads in (("num_heads", self.num_heads), ("view_transformer_n_heads", self.view_transformer_n_heads)):
            if self.latent_dim % heads or self.latent_dim // heads % 2:
                raise InputError(f"model.{stage}={heads} must divide model.latent_dim={self.latent_dim} into even heads")
        if self.pe_type == "rope":
            if self.vertex_pe_num_freqs % 2 or self.vertex_pe_num_freqs < 4:
                raise InputError(f"model.vertex_pe_num_freqs={self.vertex_pe_num_freqs} must be even and at least 4")
            if 9 * self.vertex_pe_num_freqs > self.latent_dim // self.num_heads:
                raise InputError(
                    f"model.vertex_pe_num_freqs={self.vertex_pe_num_freqs} needs heads of at least "
                    f"{9 * self.vertex_pe_num_freqs} channels, there are {self.latent_dim // self.num_heads}"
                )
            if self.view_pe_num_freqs < 4:
                raise InputError(f"model.view_transformer_n_heads={self.view_transformer_n_heads} leaves heads too narrow")
        if self.use_dpt_decoder:
            if len(self.dpt_out_channels) != 4:
                raise InputError(f"model.dpt_out_channels={self.dpt_out_channels} must be four numbers")
            if self.dpt_features % 2:
                raise InputError(f"model.dpt_features={self.dpt_features} must be even")
            layers = self.dpt_layers
            if len(layers) != 4 or not all(0 <= layer < self.view_transformer_n_layers for layer in layers):
                raise InputError(
                    f"model.dpt_out_layers={self.dpt_out_layers} with {self.view_transformer_n_layers} decoder layers: "
                    "the DPT head reads four existing layers; use at least 4 layers or use_dpt_decoder=false"
                )

    @property
    def dpt_layers(self) -> tuple[int, ...]:
        """The four decoder layers whose outputs the DPT head reads."""
        n = self.view_transformer_n_layers
        return tuple(range(n - 4, n)) if self.dpt_out_layers is None else tuple(self.dpt_out_layers)

    @property
    def view_pe_num_freqs(self) -> int:
        """n of the view stage's rotary encoding: no more than its heads hold (section 3, item 4)."""
        head_dim = self.view_transformer_latent_dim // self.view_transformer_n_heads
        return min(self.vertex_pe_num_freqs, head_dim // 18 * 2)

    @property
    def depth(self) -> int:
        """Layers of both stages."""
        return self.num_layers + self.view_transformer_n_layers

    @property
    def facts(self) -> dict[str, Any]:
        """What probes say of the network."""
        return {"layers": f"{self.num_layers} + {self.view_transformer_n_layers}", "width": self.latent_dim}

    @property
    def description(self) -> str:
        """The network's size in words."""
        return f"{self.num_layers} + {self.view_transformer_n_layers} layers, width {self.latent_dim}"

    @property
    def bundle_side(self) -> int:
        """Pixels along the side of a ray bundle."""
        return self.patch_size

    @property
    def registers(self) -> int:
        """Tokens besides those of triangles and rays."""
        return self.num_register_tokens

    @property
    def resolution_multiple(self) -> int:
        """Image sides must be multiples of this many pixels."""
        return 64 if self.view_transformer_use_swin_attn else self.patch_size

    @classmethod
    def from_dict(cls, data: dict[str, Any], where: str = "config") -> ModelConfig:
        """From a released ``config.json``; every field must be there, and no other."""
        field_names = [field.name for field in dataclasses.fields(cls)]
        unknown, missing = sorted(set(data) - set(field_names)), sorted(set(field_names) - set(data))
        if unknown:
            raise InputError(f"{where}: unknown field {', '.join(unknown)}: this code would not compute what it means")
        if missing:
            raise InputError(f"{where}: field {', '.join(missing)} is missing: a released config.json names them all")
        check_types(cls, data, where)
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in data.items()}
        try:
            return cls(**values)
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """The released ``config.json``'s content."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in dataclasses.asdict(self).items()}

    def dumps(self) -> str:
        return json.dumps(self.to_dict(), indent=2, sort_keys=True) + "\n"
