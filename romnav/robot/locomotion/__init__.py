"""Velocity-tracking walking: LIP references, a control-Lyapunov reward and PPO (CLF-RL)."""
