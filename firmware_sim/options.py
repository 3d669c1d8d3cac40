"""Options from the fields of a frozen dataclass: those of pans.runtime.cli.option_fields."""

from pans.runtime.cli.option_fields import add_options, option, words_of
from pans.runtime.cli.option_fields import options_from as settings_from

__all__ = ["add_options", "option", "settings_from", "words_of"]
