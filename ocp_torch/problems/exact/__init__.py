"""Problems whose optimum is known: what everything else is held against."""
