"""Contact segmentation: one network, run by onnxruntime on one thread.

The model contract (in full in models/README.md): inputs `frame` and `background`, each (1, H, W, 3) uint8 BGR,
`background_known`, (1,) float32; output `probability`, (1, 1, H, W) float32 in 0..1; metadata `slipguard_contract`,
`threshold`, `label`, `command`, `seed`. In version 1, H is 160 and W 120. In version 2, any size of the frame's
proportions up to 320 x 240 is allowed, and a network may take `frame` alone. Preprocessing is part of the graph.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError, ModelError
from slipguard.perception.background import estimate_background

INPUT_WIDTH_PX = FRAME_WIDTH_PX // 2
INPUT_HEIGHT_PX = FRAME_HEIGHT_PX // 2
CONTRACT = "1"
"""Networks with all three inputs at 120 x 160."""
CONTRACT_ANY_INPUT = "2"
"""Networks that take the frame alone, or another size."""
DEFAULT_MODEL = "tsnn-small.onnx"
ROUNDING = 1e-4
"""onnxruntime's sigmoid exceeds 1 by a few units in the last place."""
UNKNOWN_ODDS = 0.35 / 0.65
"""Odds of contact that count as even if the background image is estimated: the network then takes a part of an imprint
for background, and shows too little of it."""
REQUIRED_METADATA = ("slipguard_contract", "threshold", "label", "command", "seed")

_Ports = dict[str, tuple[str, list[Any]]]


def default_model_path() -> Path:
    """Return the path of the shipped network: inside an installed package, or in `models/` of a checkout.

    Raises:
        ModelError: It is in neither place.
    """
    installed = Path(str(resources.files("slipguard"))) / "models" / DEFAULT_MODEL
    checkout = Path(__file__).resolve().parents[2] / "models" / DEFAULT_MODEL
    for path in (installed, checkout):
        if path.is_file():
            return path
    raise ModelError(
        f"the shipped network is in neither {installed} nor {checkout}; reinstall slipguard or set a model"
    )


class Segmenter:
    """Estimates the contact probability of a gel frame, given the unit's background image.

    One intra-op thread; an instance belongs to one thread at a time.

    Args:
        path: An ONNX file that fulfills the model contract; None: the shipped one.

    Raises:
        ModelError: In one line, for a missing or corrupt file, another contract, missing metadata, or an output that
            is no probability or does not depend on the frame.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = default_model_path() if path is None else path
        self._session = _open(self.path)
        self._size, self._needs_background = _checked_ports(self.path, self._session)
        self.metadata: dict[str, str] = _checked_metadata(self.path, self._session)
        self.threshold = _checked_threshold(self.path, self.metadata["threshold"])
        middle = np.full((self._size[1], self._size[0], 3), 96, np.uint8)
        self._background: NDArray[np.uint8] | None = None
        self._background_small = middle
        pressed = middle.copy()
        pressed[self._size[1] // 4 : self._size[1] // 2, self._size[0] // 4 : self._size[0] // 2] = 200
        if np.array_equal(self._run(middle, middle, known=True), self._run(pressed, middle, known=True)):
            raise ModelError(f"{self.path}: the output is the same for different frames; use another model")

    @property
    def input_size(self) -> tuple[int, int]:
        """(width, height) in pixels of the network's input and output."""
        return self._size

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        """Return the probability of contact, (H, W) float32 in 0..1, at `input_size`.

        Args:
            image: (320, 240, 3) uint8 BGR.
            background: Same shape; None: it is estimated from the frame. It is resized once and remembered by
                identity: do not write into the array afterwards.

        Raises:
            InputError: Another shape or type.
            ModelError: The network fails, or its output is no probability.
        """
        small = _resized(image, self._size, "frame")
        if not self._needs_background:
            return self._run(small, small, known=False)
        if background is None:
            probability = self._run(small, estimate_background(small), known=False)
            return np.asarray(probability / (probability + UNKNOWN_ODDS * (1.0 - probability)), np.float32)
        if background is not self._background:
            self._background_small = _resized(background, self._size, "background image")
            self._background = background
        return self._run(small, self._background_small, known=True)

    def _run(self, frame: NDArray[np.uint8], background: NDArray[np.uint8], *, known: bool) -> NDArray[np.float32]:
        feed: dict[str, NDArray[Any]] = {"frame": frame[None]}
        if self._needs_background:
            known_flag = np.array([1.0 if known else 0.0], np.float32)
            feed |= {"background": background[None], "background_known": known_flag}
        try:
            output = self._session.run(["probability"], feed)[0]
        except Exception as error:
            raise ModelError(
                f"{self.path}: the network failed to run ({_first_line(error)}); use another model"
            ) from error
        probability: NDArray[np.float32] = output[0, 0]
        lowest, highest = float(probability.min()), float(probability.max())
        if not (lowest >= -ROUNDING and highest <= 1.0 + ROUNDING):  # also true of NaN
            raise ModelError(
                f"{self.path}: the output ranges over {lowest:g}..{highest:g}, expected a probability in 0..1; "
                "export the network with its sigmoid"
            )
        return np.clip(probability, 0.0, 1.0)


def _resized(image: NDArray[np.uint8], size: tuple[int, int], what: str) -> NDArray[np.uint8]:
    if image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3) or image.dtype != np.uint8:
        raise InputError(
            f"the {what} is {image.dtype} of shape {image.shape}, "
            f"expected uint8 BGR of shape ({FRAME_HEIGHT_PX}, {FRAME_WIDTH_PX}, 3)"
        )
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _open(path: Path) -> Any:
    if not path.is_file():
        raise ModelError(f"{path}: no such file; set an ONNX model, or none for the shipped one")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = 3  # errors only: hardware probing warns on many machines
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ModelError(f"{path}: not a readable ONNX model ({_first_line(error)})") from error


def _checked_ports(path: Path, session: Any) -> tuple[tuple[int, int], bool]:
    """Return (width, height) of the network's input, and whether it takes a background."""
    inputs, outputs = (
        {port.name: (port.type, port.shape) for port in ports}
        for ports in (session.get_inputs(), session.get_outputs())
    )
    takes_background = "background" in inputs
    shape = inputs.get("frame", ("", []))[1]
    height, width = shape[1:3] if len(shape) == 4 else (INPUT_HEIGHT_PX, INPUT_WIDTH_PX)
    fits = isinstance(height, int) and isinstance(width, int) and 0 < height <= FRAME_HEIGHT_PX
    if not (fits and height * FRAME_WIDTH_PX == width * FRAME_HEIGHT_PX):
        height, width = INPUT_HEIGHT_PX, INPUT_WIDTH_PX
    expected: _Ports = {"frame": ("tensor(uint8)", [1, height, width, 3])}
    if takes_background:
        expected |= {"background": expected["frame"], "background_known": ("tensor(float)", [1])}
    output: _Ports = {"probability": ("tensor(float)", [1, 1, height, width])}
    for side, found, contract in (("inputs", inputs, expected), ("outputs", outputs, output)):
        if found != contract:
            raise ModelError(f"{path}: {side} are {_ports(found)}; the model contract asks for {_ports(contract)}")
    return (width, height), takes_background


def _checked_metadata(path: Path, session: Any) -> dict[str, str]:
    try:
        metadata = dict(session.get_modelmeta().custom_metadata_map)
    except UnicodeDecodeError as error:
        raise ModelError(f"{path}: its metadata are not text ({error.reason}); the file is damaged") from error
    missing = [key for key in REQUIRED_METADATA if key not in metadata]
    if missing:
        raise ModelError(f"{path}: metadata {', '.join(missing)} missing; export it with `slipguard train`")
    if metadata["slipguard_contract"] not in (CONTRACT, CONTRACT_ANY_INPUT):
        raise ModelError(
            f"{path}: model contract {metadata['slipguard_contract']}; "
            f"this slipguard reads contracts {CONTRACT} and {CONTRACT_ANY_INPUT}"
        )
    return metadata


def _checked_threshold(path: Path, text: str) -> float:
    try:
        threshold = float(text)
    except ValueError:
        threshold = float("nan")
    if not 0.0 < threshold < 1.0:
        raise ModelError(f"{path}: metadata threshold is {text!r}, expected a number between 0 and 1")
    return threshold


def _ports(ports: _Ports) -> str:
    return ", ".join(f"{name} {kind}{shape}" for name, (kind, shape) in sorted(ports.items()))


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:160] if lines else type(error).__name__
