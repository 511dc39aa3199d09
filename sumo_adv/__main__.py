"""``python -m sumo_adv``."""

from sumo_adv.cli.main import main

if __name__ == "__main__":
    main()
