"""LaRe in your own training loop or in another library's: `CreditAssigner`, and its adapters."""
