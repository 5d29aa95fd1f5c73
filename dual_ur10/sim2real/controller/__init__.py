"""Two UR controllers in software: what clients of real ones talk to, with simulated arms behind them."""
