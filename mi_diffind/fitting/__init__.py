"""The training loop, its settings, and what every task declares."""
