"""Print what the benchmarks of contact are; each is a command of its own, such as benchmarks.contact.motions."""

from . import __doc__ as contents

if __name__ == "__main__":
    print(contents)
