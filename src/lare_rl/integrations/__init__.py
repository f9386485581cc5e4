"""Adapters for other libraries: of `CreditAssigner`, and of the language models of Pydantic AI."""
