"""phi, the function of the language model, as a graph of array operations: it is read and checked, and never executed."""
