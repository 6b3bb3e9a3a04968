"""Every setting with its default, bounds and meaning. Settings are frozen, refuse unknown names and never repair a value."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidatorFunctionWrapHandler, field_validator

Method = Literal["network", "mean", "bilateral", "jet"]


Signal = Literal["supervised", "split", "distill", "total"]
"""What a network learns from."""


class Settings(BaseModel):
    """Base of all settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DenoiseConfig(Settings):
    """How a scan is cleaned."""

    method: Method = Field("network", description="How points are moved: the learned network, or a classical filter.")
    iters: Annotated[int, Field(ge=1, le=100)] | Literal["auto"] = Field(
        1, description="Passes over the scan; auto stops by itself, without ground truth."
    )
    draws: int = Field(
        1, ge=1, le=64, description="Random choices of what the network looks at, over which its answer is averaged."
    )
    noise: float | None = Field(
        None, gt=0, le=1e15, description="Standard deviation of the noise, in the scan's unit; estimated by default."
    )
    align_by: tuple[str, ...] | None = Field(
        None,
        description="Columns: rows that agree in them are off together and first shifted together; by default the model's.",
    )
    unround: bool = Field(True, description="Bring depths that a camera rounded to steps back between the steps.")
    strength: float = Field(1.0, ge=0, le=1, description="Share of the move that is carried out.")
    max_move: float | None = Field(None, gt=0, description="Longest move of any point, in the scan's unit.")
    relax_steps: int = Field(4, ge=0, le=100, description="Steps toward even spacing, within the noise; 0 for none.")
    outliers: Literal["keep", "flag", "remove"] = Field("keep", description="What becomes of isolated points.")
    uncertainty: bool = Field(False, description="Say for every point how far it may still be off, as a standard deviation.")
    unshrink: bool | None = Field(
        None, description="Take low-frequency moves back, which shrink a cloud pass by pass; by default with mcconv models."
    )
    neighbours: int | None = Field(
        None, ge=1, le=1024, description="Neighbours of the mean filter and of jets; as many as the noise asks for by default."
    )
    radius: float | None = Field(None, gt=0, description="Radius of the bilateral filter, as a share of the diagonal.")
    sigma_d: float | None = Field(None, gt=0, description="How fast its weights fall with distance, likewise.")
    sigma_n: float | None = Field(None, gt=0, description="How fast its weights fall with height, likewise.")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")
    threads: int | None = Field(None, ge=1, description="Processor threads; all of them by default.")

    @field_validator("iters", mode="wrap")
    @classmethod
    def _passes_or_auto(cls, value: Any, validated: ValidatorFunctionWrapHandler) -> Any:
        try:
            return validated(value)
        except ValidationError:
            raise ValueError("must be a number of passes from 1 to 100, or auto") from None


class TrainConfig(Settings):
    """How a network learns."""

    method: Signal | None = Field(
        None,
        description="Signal; supervised: surfaces or clouds that are known; split: noisy points held out; distill: noisy clouds"
        " that a teacher cleaned; total: neighbours drawn by a prior. By default supervised, for scans distill.",
    )
    laps: int = Field(2, ge=1, le=20, description="Teachers of a distillation in turn: the start, then what was learned by then.")
    network: Literal["projection", "mcconv"] = Field("projection", description="Architecture; mcconv is the paper's.")
    pairs: bool = Field(False, description="Supervised by the noisy and clean clouds of synth folders, not by surfaces.")
    prior: Literal["full", "space", "none"] = Field("space", description="What makes a neighbour likely: space, and colour.")
    kernel: str = Field("gaussian", description="The prior's kernel: gaussian, wendland or imq.")
    alpha: float | None = Field(None, gt=0, description="The kernel's width in radii; the best one in the paper by default.")
    beta: float = Field(4.0, gt=0, description="Weight of colour in the prior.")
    blind_spot: bool = Field(True, description="No point is its own target.")
    regulariser: float = Field(0.1, ge=0, lt=1, description="Share of the term against clustering in the loss.")
    part_points: int = Field(150_000, ge=1000, description="Most points of a part that scans are cut to.")
    unit: float | None = Field(None, gt=0, description="The network's unit in the scans' unit; their diagonal by default.")
    width: int = Field(51, ge=4, le=256, description="Channels of mcconv's first level; 64 is the released size.")
    sampled: int | None = Field(48, ge=1, le=1024, description="Neighbours that stand for all in mcconv; none for all.")
    channels: int = Field(32, ge=4, le=256, description="Features per point.")
    neighbours: int = Field(32, ge=6, le=256, description="Neighbours that a point looks at.")
    rounds: tuple[int, ...] = Field((2, 2), min_length=1, description="Rounds of messages in each stage.")
    landing_rounds: int = Field(2, ge=1, le=8, description="Rounds of messages in which all points land on the seeds' surface.")
    messages: int | None = Field(
        None, ge=4, le=256, description="Channels of a message; as many as features, or as the model has that it starts from."
    )
    data: tuple[str, ...] = Field(
        ("shapes:400",), min_length=1, description="What to learn from: shapes:N, meshes, scans, folders; each as often."
    )
    steps: int | None = Field(None, ge=1, description="Clouds to learn from; or give a budget.")
    budget_s: float | None = Field(None, gt=0, description="Seconds to learn for; or give steps.")
    learning_rate: float | None = Field(
        None,
        gt=0,
        le=1,
        description="Peak learning rate; by default 0.003 for projection, a tenth of it to adapt a model, 0.005 for mcconv.",
    )
    seed: int = Field(1, ge=0, description="Seed of surfaces, noise and initial weights.")
    threads: int | None = Field(None, ge=1, description="Processor threads; all of them by default.")
