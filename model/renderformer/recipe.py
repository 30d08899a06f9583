"""How to train a RenderFormer: the settings of the loop, once for the library and for the command line.

Free of torch, so that a plan which only reads settings stays cheap. *train*'s config inherits these fields. The defaults are
those of ``conf/renderformer/train/default.yaml``, a run of minutes. The paper's values are in ``paper_256.yaml`` beside it.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


def _runtime(default: Any, **kwargs: Any) -> Any:
    """A field that changes at most the result's rounding, marked as the engine does it (`pipeline.config.runtime`)."""
    return Field(default, json_schema_extra={"runtime": True}, **kwargs)


class FitConfig(BaseModel):
    """What `model.renderformer.training.fit` reads."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, protected_namespaces=())

    # Schedule
    steps: int = Field(1500, ge=1)
    lr: float = Field(1e-3, gt=0)
    warmup: int = Field(50, ge=0)  # steps of linear warm-up
    decay_steps: int | None = Field(None, ge=1)  # step at which the cosine ends; None: the last step
    final_lr: float = Field(0.0, ge=0, le=1)  # after the cosine, as a share of lr
    optimizer: Literal["adamw", "muon"] = "muon"  # muon: 2-D hidden weights; AdamW for the rest
    muon_lr: float = Field(0.005, gt=0)  # highest learning rate of Muon's weights: a step's size in spectral norm
    weight_decay: float = Field(0.01, ge=0)  # on matrices; norms, biases and tokens are left alone
    clip: float = Field(1.0, gt=0)  # largest gradient norm
    # Decay of the averaged weights that are validated and saved; 0: none. It came later: old keys imply 0
    ema: float = Field(0.0, ge=0, lt=1, json_schema_extra={"legacy": 0.0})
    # mixed: view-independent stage in bfloat16 and TF32 in the other on a GPU, fp32 on a CPU; bf16: all in bfloat16, anywhere
    precision: Literal["mixed", "fp32", "bf16"] = "mixed"
    # Loss: L1 on log10(1 + x) + lpips * LPIPS(VGG)
    lpips: float = Field(0.0, ge=0)
    # Share of the gradient that pixels below 0 get besides ELU's own 1e-3: at high learning rates the output else dies
    gradient_leak: float = Field(0.1, ge=0, le=1)
    # Runtime
    lpips_folder: str | None = _runtime(None)  # folder with the published LPIPS weights; None: see model.weights
    micro_scenes: int | None = _runtime(None, ge=1)  # scenes of a process in memory at once, gradients add up; None: all
    activation_checkpointing: bool = _runtime(False)  # compute activations again instead of keeping them
    parallel: Literal["ddp", "fsdp"] = _runtime("ddp")  # under torchrun: whole models, or one split over the processes
    compile: bool = _runtime(False)  # torch.compile
    log_every: int = _runtime(50, ge=1)  # steps
    validate_every: int = _runtime(200, ge=1)
    checkpoint_every: int = _runtime(100, ge=1)
    pictures: int = _runtime(6, ge=0)  # validation scenes that are shown

    def identity(self) -> dict[str, Any]:
        """The values that decide the result, by name; of these fields only, whatever a subclass adds."""
        fields = FitConfig.model_fields.items()
        return {name: getattr(self, name) for name, field in fields if not (field.json_schema_extra or {}).get("runtime")}

    def precision_on(self, device: str) -> str:
        """fp32 | mixed | bf16: a CPU has nothing to gain from ``mixed``."""
        return "fp32" if self.precision == "mixed" and device == "cpu" else self.precision
