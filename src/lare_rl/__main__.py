"""`python -m lare_rl` is the command `lare-rl`."""

from lare_rl.cli import main

if __name__ == "__main__":
    main()
