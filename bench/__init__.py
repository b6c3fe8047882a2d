"""What the package costs and how far it is from the truth: ``python -m bench.accuracy``, ``python -m bench.speed``."""
