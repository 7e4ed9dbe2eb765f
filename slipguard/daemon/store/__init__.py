"""What the daemon keeps on disk: background images, the last grasp, references, recordings."""
