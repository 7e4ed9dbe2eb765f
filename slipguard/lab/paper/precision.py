"""Which device a network is trained on, and in which arithmetic."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch

from slipguard.errors import InputError

CHOICES = ("auto", "float32", "bfloat16", "float16")


@dataclass(frozen=True, slots=True)
class Precision:
    """name: float32, or the shorter type that convolutions are computed in while weights stay in float32."""

    name: str
    device: torch.device
    scaler: Any
    """Keeps gradients of float16 from vanishing; does nothing for the other types."""

    def autocast(self) -> AbstractContextManager[Any]:
        """The context to run the network in."""
        kind: torch.dtype = getattr(torch, self.name)
        return torch.autocast(self.device.type, kind, enabled=kind is not torch.float32)


def chosen(name: str = "auto") -> Precision:
    """The GPU where there is one. auto: bfloat16 where the hardware computes it, else float16 on a GPU, else float32.

    Raises `InputError` for float16 without a GPU and for an unknown name.
    """
    if name not in CHOICES:
        raise InputError(f"no precision {name!r}; there are: {', '.join(CHOICES)}")
    gpu = torch.cuda.is_available()
    if name == "float16" and not gpu:
        raise InputError("float16 needs a GPU; leave --precision out, or give float32 or bfloat16")
    if name == "auto":
        if torch.cuda.is_bf16_supported() if gpu else _cpu_computes_bfloat16():
            name = "bfloat16"
        else:
            name = "float16" if gpu else "float32"
    device = torch.device("cuda" if gpu else "cpu")
    return Precision(name, device, torch.amp.GradScaler(device.type, enabled=name == "float16"))


def _cpu_computes_bfloat16() -> bool:
    """AVX512_BF16 or AMX; elsewhere bfloat16 would be emulated, and slower."""
    tests = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(bool(getattr(torch.cpu, test, bool)()) for test in tests)
