"""Whether a frame may be measured: image quality, dead lines, gel wear, estimate of a missing background image."""
