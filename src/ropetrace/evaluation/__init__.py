"""How good an estimate is, and the experiments that measure it."""
