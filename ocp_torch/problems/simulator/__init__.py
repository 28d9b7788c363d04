"""A problem that is somebody's function: asked at states, alone or by worker processes, and never differentiated."""
