"""Where the object touches the gel: contact gate, segmentation, contact patch, change detection."""
