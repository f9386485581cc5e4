"""The paper's figures and tables, from one command."""
