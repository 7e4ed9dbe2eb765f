"""`python -m slipguard`."""

from slipguard.cli import main

if __name__ == "__main__":
    main()
