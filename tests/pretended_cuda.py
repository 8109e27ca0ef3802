"""A CUDA device that is pretended: its tensors compute on the CPU, and mixing them with the CPU's own fails."""

from __future__ import annotations

import dataclasses
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

CUDA, CPU, META = torch.device("cuda", 0), torch.device("cpu"), torch.device("meta")
aten = torch.ops.aten

_COPIES = {aten.copy_.default, aten.copy.default, aten._to_copy.default, aten.lift_fresh.default}
"""Calls that may have tensors of both devices."""
_WAITS = {aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default}
"""Calls whose answer the CPU has to know before it goes on."""
_INDEXED = {
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._unsafe_index.Tensor,
    aten._index_put_impl_.default,
}
"""Calls whose indices may be the CPU's."""
_NO_SCALARS = {
    "bmm",
    "cat",
    "gather",
    "index_add",
    "index_copy",
    "index_select",
    "mm",
    "scatter",
    "scatter_add",
    "searchsorted",
    "stack",
}
"""Calls that take not even a number of the CPU."""


class PretendedTensor(Tensor):
    """A tensor that says it is on CUDA; what it holds lies on the CPU.

    To C++ it is on the device "meta", which autograd knows without a GPU.
    """

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: Tensor) -> PretendedTensor:
        made = Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=META,
        )
        made.held = held
        return made

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_meta = property(lambda self: False)

    def numpy(self, *, force: bool = False) -> Any:
        """Fail as CUDA's do."""
        if not force:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")
        return self.detach().cpu().numpy()

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return self.numpy()

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def data_ptr(self) -> int:
        raise RuntimeError("memory of CUDA was asked for")

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        if id(self) not in memo:
            copied = PretendedTensor(self.held.clone())
            memo[id(self)] = (
                torch.nn.Parameter(copied, self.requires_grad)
                if isinstance(self, torch.nn.Parameter)
                else copied.requires_grad_(self.requires_grad)
            )
        return memo[id(self)]

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"Pretended({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        return _call(func, args, kwargs or {})


class _Placed(TorchDispatchMode):
    """Computes what is asked of the pretended device."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Nothing is compiled here, and torch's guard against that would cost as much as a call.
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        return _call(func, args, kwargs or {})


class _Asked(TorchFunctionMode):
    """Turns "cuda" in calls into the device that C++ knows the pretended one as."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        # Attributes are most of what is asked, and C++ knows them.
        if getattr(func, "__name__", "") in ("__get__", "_parse_to") or func is torch.device:
            return func(*args, **kwargs)
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and _is_cuda(kwargs.get("device")):
            # C++ would make a tensor of "meta" from nothing but the shape of the data.
            needs = kwargs.get("requires_grad", False)
            given = {name: value for name, value in kwargs.items() if name not in ("device", "requires_grad")}
            made = func(*args, **given).to(META)
            return made.requires_grad_() if needs else made
        if func is Tensor.new_tensor and isinstance(args[0], PretendedTensor):
            return torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype)).to(META)
        if func is Tensor.cuda:
            return args[0].to(META)
        named = [value for value in (*args, *kwargs.values()) if type(value) in _NAMES]
        if not named:
            return func(*args, **kwargs)
        if any(type(value) is torch.device and value.type == "meta" for value in named):
            with _really_meta():
                return func(*args, **kwargs)
        return func(*map(_known, args), **{name: _known(value) for name, value in kwargs.items()})


_NAMES = (str, torch.device)
"""Types of what may name a device."""
_META_IS_MEANT = [False]
"""Whether "meta" is asked for by its name: by who wants a tensor without numbers."""


@contextmanager
def _really_meta() -> Iterator[None]:
    before, _META_IS_MEANT[0] = _META_IS_MEANT[0], True
    try:
        yield
    finally:
        _META_IS_MEANT[0] = before


def _is_cuda(value: Any) -> bool:
    return (isinstance(value, torch.device) and value.type == "cuda") or value in ("cuda", "cuda:0")


def _known(value: Any) -> Any:
    return META if isinstance(value, str | torch.device) and _is_cuda(value) else value


def _call(func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Compute on the CPU what the pretended device is asked for; anything else as it is."""
    tensors = _tensors_in(args) + (_tensors_in(kwargs.values()) if kwargs else [])
    ours = any(isinstance(one, PretendedTensor) for one in tensors)
    asked = kwargs.get("device")
    placed = asked is not None and asked.type == "meta" and not _META_IS_MEANT[0]
    if not ours and not placed:
        return func(*args, **kwargs)
    if ours:
        _refuse_mixed(func, args, tensors)
    generator = kwargs.get("generator")
    if generator is not None and generator.device.type != "cuda":
        raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
    here = {name: CPU if name == "device" and placed else _held(value) for name, value in kwargs.items()}
    found = func(*map(_held, args), **here)
    written = _written(func, args, kwargs)
    if written is not None:
        return written
    return found if asked is not None and not placed else _shown(found)


_NUMBERS = frozenset({int, float, bool, type(None), torch.dtype, torch.device, torch.layout})
"""Types of arguments that hold no tensor; most calls have nothing else beside their tensors."""


def _tensors_in(values: Iterable[Any]) -> list[Tensor]:
    found = []
    for value in values:
        kind = type(value)
        if kind is PretendedTensor or kind is Tensor:
            found.append(value)
        elif kind is list or kind is tuple:
            found += _tensors_in(value)
        elif kind not in _NUMBERS and isinstance(value, Tensor):
            found.append(value)
    return found


def _held(value: Any) -> Any:
    """What the CPU computes with."""
    kind = type(value)
    if kind is PretendedTensor:
        return value.held
    if kind in _NUMBERS:
        return value
    if isinstance(value, PretendedTensor):
        return value.held
    return kind(map(_held, value)) if isinstance(value, list | tuple) else value


def _shown(value: Any) -> Any:
    """What the CPU has computed, as the pretended device's."""
    if type(value) is Tensor:
        return PretendedTensor(value)
    return type(value)(map(_shown, value)) if isinstance(value, list | tuple) else value


@cache
def _written_arguments(func: Any) -> tuple[tuple[int, str], ...]:
    """Place and name of the arguments that a call in place hands back; none for other calls."""
    schema = func._schema
    if not schema.returns or schema.returns[0].alias_info is None:
        return ()
    return tuple(
        (k, argument.name)
        for k, argument in enumerate(schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    )


def _written(func: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """The arguments that a call in place hands back, None for other calls."""
    written = tuple(kwargs[name] if name in kwargs else args[k] for k, name in _written_arguments(func))
    return written if len(written) > 1 else written[0] if written else None


def _refuse_mixed(func: Any, args: tuple, tensors: list[Tensor]) -> None:
    """Fail where CUDA would."""
    others = [one for one in tensors if not isinstance(one, PretendedTensor)]
    if not others or func in _COPIES:
        return
    name = func.overloadpacket.__name__.rstrip("_")
    if func in _INDEXED:
        if not isinstance(args[0], PretendedTensor):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        others = [one for one in args[2:3] if isinstance(one, Tensor) and not isinstance(one, PretendedTensor)]
    if any(k == 0 for k, _ in _written_arguments(func)) and not isinstance(args[0], PretendedTensor):
        raise RuntimeError(f"Expected all tensors to be on the same device: {name} writes the CPU's from CUDA's")
    if any(one.ndim > 0 or name in _NO_SCALARS for one in others):
        devices = sorted({str(one.device) for one in tensors})
        raise RuntimeError(f"Expected all tensors to be on the same device, {' and '.join(devices)}, in {func}")


@contextmanager
def pretended_cuda() -> Iterator[None]:
    """Let there be a CUDA device whose tensors compute on the CPU, and gsplat, which draws as the CPU's backend does.

    Calls that mix its tensors with the CPU's raise `RuntimeError`, and those that ask its tensors for an array
    `TypeError`, as CUDA's do. Only in the thread that enters it.
    """
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", message=".*CUDA is not available.*")
        for name, value in {
            "is_available": lambda: True,
            "device_count": lambda: 1,
            "set_device": lambda device: None,
            "synchronize": lambda device=None: None,
            "max_memory_allocated": lambda device=None: 1,
            "reset_peak_memory_stats": lambda device=None: None,
            "mem_get_info": lambda device=None: (64 << 30, 80 << 30),
            "get_device_name": lambda device=None: "pretended",
        }.items():
            stack.enter_context(mock.patch.object(torch.cuda, name, value))
        stack.enter_context(mock.patch.object(Tensor, "pin_memory", lambda self: self))
        # What `Module.to` sets in place would stay what it was to Python.
        swapped = torch.__future__.get_swap_module_params_on_conversion()
        stack.callback(torch.__future__.set_swap_module_params_on_conversion, swapped)
        torch.__future__.set_swap_module_params_on_conversion(True)
        stack.enter_context(mock.patch("avatar.rendering.gsplat_backend.rasterize_gsplat", _rasterize))
        stack.enter_context(_Asked())
        stack.enter_context(_Placed())
        yield


def _rasterize(*tensors: Any) -> Any:
    """Draw with the CPU's backend, with gradients."""
    from avatar.rendering.cpu import rasterize_cpu

    assert all(isinstance(one, PretendedTensor) for one in tensors if isinstance(one, Tensor))
    with _uncounted():
        image, alpha, meta = rasterize_cpu(*(one.cpu() if isinstance(one, Tensor) else one for one in tensors))
        fields = {field.name: getattr(meta, field.name) for field in dataclasses.fields(meta)}
        moved = {name: value.to(CUDA) if isinstance(value, Tensor) else value for name, value in fields.items()}
        return image.to(CUDA), alpha.to(CUDA), dataclasses.replace(meta, **moved)


_COUNTED = [True]


@contextmanager
def _uncounted() -> Iterator[None]:
    _COUNTED[0] = False
    try:
        yield
    finally:
        _COUNTED[0] = True


class CountedWaits(TorchDispatchMode):
    """Counts calls for which a real device would have to be waited for: numbers, and the indices of a mask.

    Copies to the CPU are not counted, because the gradients of the pretended gsplat make them.

    Attributes:
        count: of such calls, since the mode was entered.
        calls: of every call by its name, of which each would be a launch or some Python's time.
        sent: number of copies from the CPU.
    """

    def __init__(self) -> None:
        super().__init__()
        self.count = self.sent = 0
        self.calls: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if not _COUNTED[0]:
            return func(*args, **kwargs)
        self.calls[str(func)] += 1
        tensors = _tensors_in(args)
        ours = [isinstance(one, PretendedTensor) for one in tensors]
        if any(ours):
            masks = [one for one in _tensors_in(args[1:2]) if one.dtype == torch.bool]
            self.count += func in _WAITS or (func in _INDEXED and bool(masks))
        if func in _COPIES:
            to = kwargs.get("device")
            self.sent += ours == [True, False] or (ours == [False] and to is not None and to.type == "meta")
        return func(*args, **kwargs)
