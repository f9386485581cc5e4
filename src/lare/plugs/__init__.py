"""LaRe in training loops that other people wrote: `CreditAssigner`, and what puts it into other libraries."""
