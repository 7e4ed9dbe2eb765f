"""segmentation-models-pytorch where torch has no GPU code and torchvision has nothing else.

torchvision's wheels on PyPI are built for CUDA. Beside a CPU torch their library does not load, and the import stops
because two operators, which no segmentation network uses, are unknown. Only then are they declared, without a body.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import Any

from slipguard.errors import InputError

_OPERATORS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
_declared: list[Any] = []
"""Keeps the declarations: they vanish with the object that made them."""


def segmentation_models() -> Any:
    """The module segmentation_models_pytorch. Raises `InputError` where it or torchvision is not installed.

    A torchvision that works is used as it is; nothing is declared then.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the parts of torchvision that read images
        try:
            try:
                importlib.import_module("torchvision")
            except RuntimeError as error:
                if "torchvision::" not in str(error):
                    raise
                _declare_operators()
            return importlib.import_module("segmentation_models_pytorch")
        except ImportError as error:
            raise InputError(
                f"the paper's networks need {error.name or 'segmentation-models-pytorch'}; install with: "
                "pip install 'slipguard[train]' --extra-index-url https://download.pytorch.org/whl/cpu"
            ) from error


def _declare_operators() -> None:
    torch: Any = importlib.import_module("torch")
    for name in [name for name in sys.modules if name == "torchvision" or name.startswith("torchvision.")]:
        del sys.modules[name]  # what the failed import left half done
    library = torch.library.Library("torchvision", "DEF")
    for operator in _OPERATORS:
        library.define(operator)
    _declared.append(library)
