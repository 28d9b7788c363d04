"""How work is carried out: on several cores, in the processes of torchrun, from CUDA graphs."""
