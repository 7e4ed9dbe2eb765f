"""slipguard keeps a robot from dropping what it holds."""

import os

# onnxruntime >= 1.29 writes usage records to the user's home when it is imported; this switches them off.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

IMAGE_PIXELS_MAX = 12_500_000
"""Of every image file, also of an external camera: 4K has 8.3 million, a page of 300 dpi 8.7, many photos 12.2."""
# OpenCV reads it once, when it is imported, and compares it with an image's header before it decodes.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(IMAGE_PIXELS_MAX)

__version__ = "0.1.0"
