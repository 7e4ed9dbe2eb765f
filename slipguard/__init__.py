"""slipguard keeps a robot from dropping what it holds."""

import os

# onnxruntime >= 1.29 writes usage records to the user's home when it is imported; this switches them off.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"

__version__ = "0.1.0"
