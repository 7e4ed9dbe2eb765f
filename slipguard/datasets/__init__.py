"""Labeled gel images: rendered, imported or recorded, and the scores of masks."""
