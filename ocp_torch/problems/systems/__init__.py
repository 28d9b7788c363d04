"""Systems people have: arms, vehicles, oscillators, a pendulum."""
