"""The grasp-and-lift experiment against markers that an external camera sees."""
