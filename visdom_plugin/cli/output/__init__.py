"""What commands say and make of finished runs: lines on the terminal, reports."""
