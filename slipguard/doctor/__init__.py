"""`slipguard doctor`: a look at everything a cell is made of, with what to do. It moves nothing."""
