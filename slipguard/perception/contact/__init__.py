"""Where the object touches the gel: contact gate, segmentation, patch, change detection."""
