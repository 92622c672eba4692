"""A weakly compressible SPH solver on jfrnn: a scene says what it has, and exactly that is compiled."""
