"""Benchmarks of methods and models: what each reaches after how many samples and how many seconds."""
