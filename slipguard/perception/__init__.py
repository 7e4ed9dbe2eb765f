"""From a gel frame to a signed rotation with its uncertainty; pure functions and small state, no I/O but onnxruntime.

The path of one frame, `pipeline.Pipeline.process`:
    contact.change_detector   image unchanged: repeat the last estimate
    rotation.rotation_meter   contact moves as a whole: its texture alone, without the network
    contact.gate              no contact: skip the rest
    contact.segmenter, patch  network, contact patch; then quality.image_quality
    rotation.rotation_meter   the texture since the reference; rotation/__init__.py lists the files
    estimate                  the result: rotation and sigma, or `declined` with the reason
"""
