"""The settings of a made-up place."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipeline.config import Section, added, report

ObjectName = Literal["car", "house", "tree"]


class StreetConfig(Section):
    """A procedural place, its cameras and its LiDAR. Lengths in metres."""

    preset: Literal["street", "drone", "object"] = "street"
    object: ObjectName = added("car", legacy="car")  # of the preset object: one thing over white, from all sides
    seed: int = Field(0, ge=0)  # of the place; another seed, another place
    length: float = Field(260.0, ge=90, le=2000)  # of the street, or of each side of the blocks
    texture_size: int = Field(1024, ge=64, le=4096)  # pixels along a wall's texture, which spans 7.5 m
    width: int = Field(384, ge=16)  # pixels
    height: int = Field(216, ge=16)
    fov_deg: float = Field(70.0, gt=10, lt=150)  # full angle across the width
    spp: int = Field(16, ge=1)  # samples a pixel, then denoised
    training_frames: int = Field(24, ge=2)
    spacing: float = Field(1.0, gt=0, le=1.5)  # between neighbours of the drive, of which every other is held out
    shifts: tuple[float, ...] = (-3.0, -2.0, 2.0, 3.0)  # lanes beside the drive, to the right of it
    shift_frames: int = Field(5, ge=0)  # of each lane
    speed: float = Field(5.0, gt=0)  # of the car that carries the LiDAR, m/s; it turns ten times a second
    beams: int = Field(64, ge=1)
    columns: int = Field(900, ge=8)  # directions of one turn
    true_mesh: bool = report(False, legacy=False)  # what was path traced is given as the mesh, as far as the LiDAR reaches

    @model_validator(mode="after")
    def _fits(self) -> StreetConfig:
        if any(abs(shift) > 3 for shift in self.shifts):
            raise ValueError(f"shifts={list(self.shifts)}: parked cars leave 3 m to each side of the drive")
        if self.preset == "street" and self.drive > self.length - 60:
            raise ValueError(
                f"training_frames={self.training_frames} at spacing={self.spacing} drive {self.drive:g} m: "
                f"give the street length={self.drive + 60:g} or more"
            )
        return self

    @property
    def drive(self) -> float:
        """Metres from the first training frame to the last."""
        return 2 * (self.training_frames - 1) * self.spacing
