"""`slipguard doctor`: checks of the machine, the daemon and the devices."""
