"""The warm start: value iteration along simulated pieces of trajectory, before the first step. Imports what training may."""
