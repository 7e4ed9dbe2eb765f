"""Which device a network is trained on, and in which arithmetic."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import torch


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


def chosen(bfloat16: bool = False) -> Precision:
    """The GPU where there is one, in bfloat16 if it has that and else in float16; else the CPU, in float32 or bfloat16.

    bfloat16 on a CPU is left to who knows it: with AVX512-BF16 or AMX it halves the time, elsewhere it multiplies it.
    """
    gpu = torch.cuda.is_available()
    if gpu:
        name = "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float16"
    else:
        name = "bfloat16" if bfloat16 else "float32"
    device = torch.device("cuda" if gpu else "cpu")
    return Precision(name, device, torch.amp.GradScaler(device.type, enabled=name == "float16"))
