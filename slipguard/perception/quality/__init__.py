"""Whether a frame is fit to measure: background images, gel wear, dead lines, image quality."""
