"""The paper's numerical section, reproduced: its recipes, what it measures, and its figures."""
