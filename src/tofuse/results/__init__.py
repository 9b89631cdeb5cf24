"""What a run gives: its types, the verdict, and the output folder of the contract."""
