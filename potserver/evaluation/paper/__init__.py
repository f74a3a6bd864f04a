"""The paper's tables and ours beside them, each a list of cells that are run once and kept: `potserver eval paper`."""
