"""Every setting with its default, bounds and meaning. Settings are frozen, refuse unknown names and never repair a value."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Method = Literal["network", "mean", "bilateral", "jet"]


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class DenoiseConfig(Settings):
    """How a scan is cleaned."""

    method: Method = Field("network", description="How points are moved: the learned network, or a classical filter.")
    iters: Annotated[int, Field(ge=1, le=100)] | Literal["auto"] = Field(
        1, description="Passes over the scan; auto stops by itself, without ground truth."
    )
    strength: float = Field(1.0, ge=0, le=1, description="Share of the move that is carried out.")
    max_move: float | None = Field(None, gt=0, description="Longest move of any point, in the scan's unit.")
    relax_steps: int = Field(4, ge=0, le=100, description="Steps toward even spacing, within the noise; 0 for none.")
    outliers: Literal["keep", "flag", "remove"] = Field("keep", description="What becomes of isolated points.")
    neighbours: int = Field(24, ge=6, le=1024, description="Neighbours of a classical filter.")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")
    threads: int | None = Field(None, ge=1, description="Processor threads; all of them by default.")


class TrainConfig(Settings):
    """How a network learns."""

    method: Literal["supervised"] = Field("supervised", description="Signal; supervised: surfaces that are known exactly.")
    network: Literal["projection"] = Field("projection", description="Architecture.")
    channels: int = Field(32, ge=4, le=256, description="Features per point.")
    neighbours: int = Field(32, ge=6, le=256, description="Neighbours that a point looks at.")
    rounds: tuple[int, ...] = Field((2, 2), min_length=1, description="Rounds of messages in each stage.")
    landing_rounds: int = Field(2, ge=1, le=8, description="Rounds of messages in which all points land on the seeds' surface.")
    data: tuple[str, ...] = Field(
        ("shapes:400",), min_length=1, description="What to learn from: shapes:N, meshes, folders of meshes; each as often."
    )
    steps: int | None = Field(None, ge=1, description="Clouds to learn from; or give a budget.")
    budget_s: float | None = Field(None, gt=0, description="Seconds to learn for; or give steps.")
    learning_rate: float = Field(3e-3, gt=0, le=1, description="Peak learning rate; it warms up and decays to a hundredth.")
    seed: int = Field(1, ge=0, description="Seed of surfaces, noise and initial weights.")
    threads: int | None = Field(None, ge=1, description="Processor threads; all of them by default.")
