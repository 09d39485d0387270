"""One page per evaluation: what a detector finds, misses and misplaces, in numbers, curves and pictures."""
