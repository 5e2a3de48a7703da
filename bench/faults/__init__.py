"""Plant small faults in kernels and nodes, one at a time, and see which tests find them."""
