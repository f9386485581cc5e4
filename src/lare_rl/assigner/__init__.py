"""`CreditAssigner`: proxy rewards for your own training loop."""
