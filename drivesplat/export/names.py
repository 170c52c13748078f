"""Names of groups as other programs allow them."""

from collections.abc import Callable, Iterable


def distinct(names: Iterable[str], spelled: Callable[[str], str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Every name as `spelled` writes it, no two alike nor like one that is `taken`, even where case does not count.

    Of several that would be written alike the first stays so; the others end in _2, _3, ...
    """
    used = {word.casefold() for word in taken}
    found = {}
    for name in names:
        word, number = spelled(name), 1
        while word.casefold() in used:
            number += 1
            word = f"{spelled(name)}_{number}"
        used.add(word.casefold())
        found[name] = word
    return found
