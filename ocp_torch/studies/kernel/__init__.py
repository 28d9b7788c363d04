"""The paper's methods in a reproducing-kernel space, as written there: exact kernel or truncated features, in NumPy."""
