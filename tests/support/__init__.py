"""What tests share: problems with their truth, runs that cost little, command lines in this process, damaged files."""
