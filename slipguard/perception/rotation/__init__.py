"""How far the contact has rotated since the reference: axes, contour and texture registration, tracking."""
