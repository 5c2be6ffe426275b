"""The compiled op as torch sees it: shapes without data, gradients, vmap. Nothing here computes a pixel."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from . import reference

try:
    from . import _C  # noqa: F401  importing registers torch.ops.fisheyerec
except ImportError as error:
    raise RuntimeError(
        "fisheyerec: the compiled torch op fisheyerec._C cannot be loaded; reinstall with `pip install .` "
        f"from the project folder ({error})"
    ) from error

_RESAMPLE = "fisheyerec::resample"
_BACKWARD = "fisheyerec::resample_backward"


def resample(
    image: Tensor,
    source: Tensor,
    target: Tensor,
    source_from_target: Tensor | None,
    source_model: str,
    target_model: str,
    height: int,
    width: int,
    interpolation: str,
    padding: str,
) -> tuple[Tensor, Tensor]:
    """Resample on whatever device the image lives on; arguments and results as in `reference.resample`.

    The CPU runs the compiled op; every other device runs the reference composition, see `backend_for`.
    Camera parameters and rotations in half precision are raised to float32 first.
    """
    _refuse_forward_mode(image, source, target, source_from_target)
    source, target = _at_least_float32(source), _at_least_float32(target)
    if source_from_target is not None:
        source_from_target = _at_least_float32(source_from_target)
    op = torch.ops.fisheyerec.resample if image.device.type == "cpu" else reference.resample
    return op(
        image,
        source,
        target,
        source_from_target,
        source_model,
        target_model,
        height,
        width,
        interpolation,
        padding,
    )


def backend_for(device: torch.device | str) -> str:
    """Name what computes on a device: "native", the compiled op, or "reference", plain torch."""
    return "native" if torch.device(device).type == "cpu" else "reference"


def _refuse_forward_mode(*tensors: Tensor | None) -> None:
    """Raise where derivatives are carried forward, which torch would drop without a word."""
    if not torch.compiler.is_compiling():
        for tensor in tensors:
            if tensor is not None and unpack_dual(tensor).tangent is not None:  # type: ignore[no-untyped-call]
                raise RuntimeError(
                    "rectify(): expected derivatives in reverse mode; forward mode (torch.func.jvp) is not supported"
                )


def _at_least_float32(params: Tensor) -> Tensor:
    return params if params.dtype in (torch.float32, torch.float64) else params.float()


def _memory_format(image: Tensor) -> torch.memory_format:
    channels_last = image.stride(1) == 1 and image.shape[1] > 1 and not image.is_contiguous()
    return torch.channels_last if channels_last else torch.contiguous_format


@torch.library.register_fake(_RESAMPLE)
def _resample_fake(
    image: Tensor,
    source: Tensor,
    target: Tensor,
    source_from_target: Tensor | None,
    source_model: str,
    target_model: str,
    height: int,
    width: int,
    interpolation: str,
    padding: str,
) -> tuple[Tensor, Tensor]:
    batch, channels = image.shape[:2]
    out = torch.empty(
        (batch, channels, height, width),
        dtype=image.dtype,
        device=image.device,
        memory_format=_memory_format(image),
    )
    return out, image.new_empty((batch, 1, height, width), dtype=torch.bool)


@torch.library.register_fake(_BACKWARD)
def _backward_fake(
    grad: Tensor,
    image: Tensor,
    source: Tensor,
    target: Tensor,
    source_from_target: Tensor | None,
    source_model: str,
    target_model: str,
    interpolation: str,
    padding: str,
    need_image: bool,
    need_source: bool,
    need_target: bool,
    need_rotation: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    def like(needed: bool, tensor: Tensor) -> Tensor:
        return tensor.new_empty(tensor.shape if needed else (0,))

    grad_image = torch.empty(
        image.shape if need_image else (0,),
        dtype=image.dtype,
        device=image.device,
        memory_format=_memory_format(image) if need_image else torch.contiguous_format,
    )
    rotation = image if source_from_target is None else source_from_target
    return (
        grad_image,
        like(need_source, source),
        like(need_target, target),
        like(need_rotation, rotation),
    )


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    image, source, target, source_from_target, *rest = inputs
    source_model, target_model, _, _, interpolation, padding = rest
    ctx.save_for_backward(image, source, target, source_from_target)
    ctx.options = (source_model, target_model, interpolation, padding)
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)  # or a mask of zeros would be made for each backward


def _backward(ctx: Any, grad: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
    if grad is None:
        return (None,) * 10
    image, source, target, source_from_target = ctx.saved_tensors
    needs = ctx.needs_input_grad[:4]
    gradients = torch.ops.fisheyerec.resample_backward(
        grad, image, source, target, source_from_target, *ctx.options, *needs
    )
    wanted = [g if need else None for g, need in zip(gradients, needs, strict=True)]
    return (*wanted, *[None] * 6)


def _no_double_backward(ctx: Any, *grads: Tensor) -> None:
    raise RuntimeError("rectify(): expected a first derivative; double backward (create_graph=True) is not supported")


torch.library.register_autograd(_RESAMPLE, _backward, setup_context=_setup_context)
torch.library.register_autograd(_BACKWARD, _no_double_backward, setup_context=lambda *_, **__: None)


def _fold(tensor: Tensor | None, dim: int | None, size: int, batch: int) -> Tensor | None:
    """Merge a vmapped dimension into the batch: (V, B or 1, ...) -> (V B, ...); None stays None."""
    if tensor is None:
        return None
    moved = tensor[None] if dim is None else tensor.movedim(dim, 0)
    return moved.expand(size, batch, *moved.shape[2:]).reshape(size * batch, *moved.shape[2:])


def _batch(image: Tensor, dim: int | None) -> int:
    return image.shape[0] if dim is None else image.movedim(dim, 0).shape[1]


@torch.library.register_vmap(_RESAMPLE)
def _resample_vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
    size, batch = info.batch_size, _batch(args[0], in_dims[0])
    tensors = [_fold(args[i], in_dims[i], size, batch) for i in range(4)]
    out = torch.ops.fisheyerec.resample(*tensors, *args[4:])
    return tuple(x.reshape(size, batch, *x.shape[1:]) for x in out), (0, 0)


@torch.library.register_vmap(_BACKWARD)
def _backward_vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[Any, Any]:
    size, batch = info.batch_size, _batch(args[0], in_dims[0])
    tensors = [_fold(args[i], in_dims[i], size, batch) for i in range(5)]
    gradients = torch.ops.fisheyerec.resample_backward(*tensors, *args[5:])

    def unfold(gradient: Tensor, needed: bool, i: int) -> Tensor:
        if not needed:
            return gradient.expand(size, 0)
        gradient = gradient.reshape(size, batch, *gradient.shape[1:])
        repeated = args[i].movedim(in_dims[i] or 0, 0).shape[int(in_dims[i] is not None)] != batch
        return gradient.sum(1, keepdim=True) if repeated else gradient

    unfolded = [unfold(g, args[9 + i], 1 + i) for i, g in enumerate(gradients)]
    return tuple(unfolded), (0, 0, 0, 0)
