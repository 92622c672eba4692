"""What measures and validates the fluid solver `jfrnn.sph`."""
