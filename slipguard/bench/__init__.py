"""Time and error of perception pipelines on this machine, and grip controllers in closed loop."""
