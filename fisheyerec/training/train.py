"""Training networks that tell the lens: one loop on Lightning Fabric, for one process or many, resuming exactly."""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from ..baselines.rong import RongNetwork
from ..network import FishEyeRecNet, LensNetwork
from ..weights import fill, read_tensors, save_network
from .batches import AugmentedPairs, Batch, load_batches
from .checkpoints import list_checkpoints, load_checkpoint, save_checkpoint
from .log import TrainingLog
from .losses import (
    UNLABELLED,
    classification_loss,
    coarse_labels,
    displacement,
    lens_loss,
    parsing_loss,
    rectification_loss,
)
from .sources import SourceError, Sources
from .synthesis import SyntheticPairs
from .validation import Validation, validate


@dataclass(frozen=True)
class TrainingRecipe:
    """How to train: losses, optimiser, schedule and data.

    Attributes:
        name: "paper", "modern" or "rong".
        rectification: lambda_1, the weight of L_r.
        parsing: lambda_2, the weight of L_sp.
        lens: weight of the loss on the lens.
        classification: weight of the cross-entropy of a network that classifies lenses.
        landing: weight of the mean displacement in pixels.
        optimizer: "adagrad" or "adamw".
        learning_rate: at its highest.
        weight_decay: of AdamW.
        clip: largest norm of the gradient; 0 for no limit.
        pairs: the recipe of the synthetic pairs.
        augment: whether pictures are turned and developed.
        frozen_parsing: the last part of the steps in which the parsing is frozen and lambda_2 = 0.
        schedule: "cosine" with warm-up, or "tenth" every 200,000 steps.
    """

    name: str
    rectification: float
    parsing: float
    lens: float
    classification: float
    landing: float
    optimizer: str
    learning_rate: float
    weight_decay: float
    clip: float
    pairs: str
    augment: bool
    frozen_parsing: float
    schedule: str


PAPER = TrainingRecipe("paper", 1.0, 15.0, 0.0, 0.0, 0.0, "adagrad", 1e-3, 0.0, 0.0, "standard", False, 0.5, "tenth")
MODERN = TrainingRecipe("modern", 0.0, 0.02, 1.0, 0.0, 0.0, "adamw", 1e-3, 0.02, 2.0, "wide", True, 0.0, "cosine")
RONG = replace(MODERN, name="rong", parsing=0.0, lens=0.0, classification=1.0)
RECIPES = {recipe.name: recipe for recipe in (PAPER, MODERN, RONG)}

# Not the displacement: most of it is the principal point, of which no network has learnt anything.
_BEST_BY = "validation_profile_r2"
_WARM_UP_STEPS = 200
_PAPER_DROP_STEPS = 200_000


@dataclass(frozen=True)
class TrainingOptions:
    """What a run is; two runs of the same options on one kind of processor give the same weights."""

    network: str = "compact"
    """"paper", "compact" or, with the recipe of this name only, "rong"."""
    num_classes: int = 8
    scene_parsing: bool = True
    """False: "-SPN -SL"."""
    recipe: TrainingRecipe = field(default=MODERN)
    """recipe.parsing = 0 gives "-SL"."""
    steps: int = 10_000
    batch_size: int = 32
    """Over all processes and accumulated parts together."""
    accumulate: int = 1
    """Parts that a process's share of the batch is worked off in."""
    seed: int = 0
    log_every: int = 50
    validate_every: int = 500
    checkpoint_every: int = 250
    validation_pairs: int = 256


def train(
    folder: Path,
    sources: Sources,
    validation_sources: Sources,
    options: TrainingOptions,
    *,
    vgg16: Path | None = None,
    start_from: Path | None = None,
    workers: int = 1,
    fabric: Fabric | None = None,
    report: Callable[[dict[str, Any]], None] = lambda row: None,
    warn: Callable[[str], None] = lambda message: None,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, losses: None,
    stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Train, or go on where the folder's last checkpoint stands.

    Args:
        folder: for checkpoints, log.csv, TensorBoard events and best.safetensors.
        sources: to train on.
        validation_sources: to choose the best by.
        options: what to train and how.
        vgg16: ImageNet weights for the base of the "paper" network; not read where training goes on.
        start_from: a file of weights to begin with, in place of chance; not read where training goes on.
        workers: processes that make pairs.
        fabric: where to run; None for one process on the CPU.
        report: called with each row of the log.
        warn: called with one line for each source that is skipped, and their count.
        on_step: called after each step with how many were made and the losses of this one.
        stop: asked after each step; True in any process ends training with a checkpoint in all of them.

    Returns:
        The file of the best weights by validation, which is there once a validation was made.

    Raises:
        ValueError: options that contradict the checkpoint, a broken checkpoint, no usable source, or labels beyond
            the classes.
        FloatingPointError: the loss or its gradient is not finite; the weights of the step before are kept.
    """
    fabric = fabric or Fabric(accelerator="cpu", devices=1)
    fabric.launch()
    parts = fabric.world_size * options.accumulate
    share, rest = divmod(options.batch_size, parts)
    if rest or not share:
        raise ValueError(
            f"train(): expected batch_size as a multiple of processes x accumulate = {parts}, got {options.batch_size}"
        )
    largest_label = options.num_classes if options.scene_parsing else 255
    sources, validation_sources = (_decoded(each, largest_label, warn) for each in (sources, validation_sources))
    names = zlib.crc32("\n".join(source.name for source in sources).encode())
    recipe = options.recipe
    checkpoint = next(reversed(list_checkpoints(folder)), None)
    fabric.seed_everything(options.seed, verbose=False)
    network = _build(options)
    size = (network.longer_side, network.longer_side)
    pairs = SyntheticPairs(
        sources, recipe=recipe.pairs, size=size, seed=options.seed, split="training", rectified=recipe.rectification > 0
    )
    validation = Validation(
        SyntheticPairs(validation_sources, size=size, seed=options.seed, split="validation"), options.validation_pairs
    )
    if vgg16 is not None and checkpoint is None:
        if not isinstance(network, FishEyeRecNet):
            raise ValueError(f"train(): expected vgg16 for a network with the paper's VGG-16 base, got {vgg16}")
        network.load_vgg16(vgg16)
    if start_from is not None and checkpoint is None:
        fill(network, read_tensors(start_from), str(start_from))
    model, optimizer = fabric.setup(network, _optimizer(network, recipe), move_to_device=True)
    step, best, window = 0, -math.inf, []
    if checkpoint is not None:
        state = _resume(checkpoint, network, optimizer, fabric, options, names)
        step, best, window = state["step"], state["best"], state.get("window", [])
    log = TrainingLog(folder, fabric.is_global_zero)
    log.begin(step)

    batches = load_batches(
        AugmentedPairs(pairs, recipe.augment),
        range(step, options.steps),
        options.batch_size,
        rank=fabric.global_rank,
        world_size=fabric.world_size,
        workers=workers,
    )
    begun, begun_at = step, time.perf_counter()
    with closing(log):
        for batch in batches:
            network.train()
            _set_learning_rate(optimizer, recipe, step, options.steps)
            _seed_chance(options.seed, step, fabric.global_rank)
            frozen = step >= options.steps * (1 - recipe.frozen_parsing)
            losses = _step(fabric, network, model, optimizer, batch, share, recipe, step, frozen)
            window.append(losses)
            step += 1
            on_step(step, losses)
            last = step == options.steps
            validates = last or step % options.validate_every == 0
            if last or validates or step % options.log_every == 0:
                means = {name: sum(each[name] for each in window) / len(window) for name in losses}
                rate = (step - begun) * options.batch_size / (time.perf_counter() - begun_at)
                row: dict[str, Any] = {name: _over_processes(fabric, "mean", mean) for name, mean in means.items()}
                row |= {"step": step, "pictures": step * options.batch_size, "pictures_per_s": rate}
                row["eta_s"] = (options.steps - step) * options.batch_size / rate
                window.clear()
                if validates:
                    result = validate(network, validation, fabric.device)
                    row |= result.numbers
                    if fabric.is_global_zero and result.numbers[_BEST_BY] > best:
                        best = result.numbers[_BEST_BY]
                        save_network(network, folder / "best.safetensors", {"options": asdict(options), "log": row})
                    log.show(step, result.pictures)
                log.write(row)
                report(row)
            stopping = _over_processes(fabric, "sum", stop()) > 0
            if (last or stopping or step % options.checkpoint_every == 0) and fabric.is_global_zero:
                state = {
                    "step": step,
                    "best": best,
                    "window": window,
                    "optimizer": optimizer.state_dict(),
                    "precision": fabric.strategy.precision.state_dict(),
                    "sources": names,
                }
                save_checkpoint(folder, step, network.state_dict(), state, asdict(options))
            if stopping:
                break
    fabric.barrier()
    return folder / "best.safetensors"


def compute_losses(
    network: nn.Module,
    batch: Batch,
    recipe: TrainingRecipe,
    frozen_parsing: bool = False,
    parsing_balance: float = 1.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Give the weighted sum of a recipe's losses over a batch, and each of them.

    Args:
        network: a LensNetwork, perhaps wrapped.
        batch: on the network's device.
        recipe: the weights.
        frozen_parsing: lambda_2 = 0.
        parsing_balance: labelled pixels of this batch, relative to the mean of all the batches of one step.
    """
    output = network(batch.fisheye.float() / 255, straighten=recipe.rectification > 0)
    size = output.camera.image_size
    losses: dict[str, Tensor] = {}
    weights = {"rectification": recipe.rectification, "lens": recipe.lens, "landing": recipe.landing}
    weights["classification"] = recipe.classification
    if output.image is not None:
        losses["rectification"] = rectification_loss(output.image, batch.rectified.float() / 255)
    if recipe.lens:
        losses["lens"] = lens_loss(output.estimate, batch.camera, size)
    if recipe.classification:
        losses["classification"] = classification_loss(output.estimate, batch.camera, size)
    losses["landing"] = displacement(output.camera, output.view, batch.camera).mean()
    if output.parsing is not None and recipe.parsing and not frozen_parsing:
        weights["parsing"] = recipe.parsing
        losses["parsing"] = parsing_balance * (
            (parsing_loss(output.first_parsing, batch.labels) + parsing_loss(output.parsing, batch.labels)) / 2
        )
    total = sum((weights[name] * loss.float() for name, loss in losses.items() if weights[name]), torch.zeros(()))
    return total, losses


def _build(options: TrainingOptions) -> LensNetwork:
    """Build the network of a run, which a recipe must teach what it emits."""
    if (options.network == "rong") != (options.recipe.classification > 0):
        raise ValueError(
            'train(): expected network "rong" with recipe "rong", and neither with another, '
            f'got network "{options.network}" with recipe "{options.recipe.name}"'
        )
    if options.network == "rong":
        return RongNetwork()
    return FishEyeRecNet.from_design(
        {"network": options.network, "num_classes": options.num_classes, "scene_parsing": options.scene_parsing}
    )


def _step(
    fabric: Fabric,
    network: LensNetwork,
    model: Any,
    optimizer: Any,
    batch: Batch,
    share: int,
    recipe: TrainingRecipe,
    step: int,
    frozen: bool,
) -> dict[str, float]:
    """Make one optimiser step over this process's part of the batch, `share` pairs at a time."""
    optimizer.zero_grad()
    count = len(batch.camera) // share
    balances = _parsing_balances(fabric, network, batch.labels, share)
    sums: dict[str, float] = {}
    for part in range(count):
        piece = Batch(*(fabric.to_device(tensor[part * share : (part + 1) * share]) for tensor in batch))
        with fabric.no_backward_sync(model, enabled=part < count - 1):
            total, losses = compute_losses(model, piece, recipe, frozen, balances[part])
            fabric.backward(total / count)
        for name, loss in {"loss": total, **losses}.items():
            sums[name] = sums.get(name, 0.0) + loss.item() / count
    if frozen and network.parsing is not None:
        # Not requires_grad_(False): DistributedDataParallel waits for the gradient of every parameter it began with.
        for parameter in network.parsing.parameters():
            parameter.grad = None
    norm: Any = fabric.clip_gradients(model, optimizer, max_norm=recipe.clip or math.inf, error_if_nonfinite=False)
    # A gradient scaler overflows now and then, and skips these steps itself.
    scaled = getattr(fabric.strategy.precision, "scaler", None) is not None
    if not math.isfinite(sums["loss"]) or not (scaled or math.isfinite(norm)):
        raise FloatingPointError(
            f"train(): expected a finite loss and gradient, got {sums['loss']} and {float(norm)} at step {step}"
        )
    optimizer.step()
    return sums


def _parsing_balances(fabric: Fabric, network: LensNetwork, labels: Tensor, share: int) -> list[float]:
    """Weigh the parts of a batch by their labelled pixels, so that together they give the loss of the whole batch."""
    if network.parsing is None:
        return [1.0] * (len(labels) // share)
    known = coarse_labels(labels, network.parsing.unshuffle.downscale_factor) != UNLABELLED
    counts = [int(known[start : start + share].sum()) for start in range(0, len(labels), share)]
    total = _over_processes(fabric, "sum", sum(counts))
    return [count * len(counts) * fabric.world_size / total if total else 1.0 for count in counts]


def _over_processes(fabric: Fabric, operation: str, value: float) -> float:
    reduced: Any = fabric.all_reduce(torch.tensor(value, dtype=torch.float64), reduce_op=operation)
    return float(reduced)


def _seed_chance(seed: int, step: int, rank: int) -> None:
    """Make drop-out depend on the step and the process alone, so that it is the same after resuming on any device."""
    torch.manual_seed(int(np.random.SeedSequence([seed, step, rank]).generate_state(1)[0]))


def _optimizer(network: nn.Module, recipe: TrainingRecipe) -> torch.optim.Optimizer:
    if recipe.optimizer == "adagrad":
        return torch.optim.Adagrad(network.parameters(), lr=recipe.learning_rate)
    matrices = [p for p in network.parameters() if p.ndim > 1]
    vectors = [p for p in network.parameters() if p.ndim <= 1]  # biases and normalisations do not decay
    groups = [{"params": matrices, "weight_decay": recipe.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=recipe.learning_rate)


def _set_learning_rate(optimizer: Any, recipe: TrainingRecipe, step: int, steps: int) -> None:
    if recipe.schedule == "tenth":
        factor = 0.1 ** (step // _PAPER_DROP_STEPS)
    else:
        warm_up = min(1.0, (step + 1) / min(_WARM_UP_STEPS, max(1, steps // 10)))
        factor = warm_up * (0.01 + 0.99 * (1 + math.cos(math.pi * step / steps)) / 2)
    for group in optimizer.param_groups:
        group["lr"] = recipe.learning_rate * factor


def _decoded(sources: Sources, largest_label: int, warn: Callable[[str], None]) -> Sources:
    skipped: list[SourceError] = []
    decoded = sources.into_memory(on_failure=skipped.append)
    for error in skipped:
        warn(str(error))
    if skipped:
        warn(f"{len(skipped)} of {len(sources)} sources cannot be read and are left out")
    if not len(decoded):
        raise ValueError("train(): expected at least one source that can be read, got none")
    for number, source in enumerate(decoded):
        labels = decoded.decode(number).labels
        if labels is not None and labels.max() > largest_label:
            raise ValueError(
                f"train(): expected labels up to the number of classes, {largest_label}, in {source.labels_path}, "
                f"got {labels.max()}"
            )
    return decoded


def _resume(
    path: Path, network: LensNetwork, optimizer: Any, fabric: Fabric, options: TrainingOptions, names: int
) -> dict[str, Any]:
    """Put a checkpoint into network, optimiser and gradient scaler, and give the rest of its state."""
    weights, state, saved = load_checkpoint(path)
    asked = json.loads(json.dumps(asdict(options)))
    for name in asked:
        if saved.get(name) != asked[name]:
            raise ValueError(
                f"train(): expected the options of the checkpoint {path}, which has {name} = {saved.get(name)}, "
                f"got {asked[name]}; choose another folder for another run"
            )
    if state.get("sources", names) != names:
        raise ValueError(
            f"train(): expected the sources that the checkpoint {path} was trained on, got others; "
            "choose another folder for another run"
        )
    fill(network, weights, str(path))
    optimizer.load_state_dict(state["optimizer"])
    if state.get("precision"):
        fabric.strategy.precision.load_state_dict(state["precision"])
    return state
