"""One sentence for the user out of what pydantic found wrong."""

from difflib import get_close_matches

from pydantic import BaseModel, ValidationError


def dotted(location: tuple[int | str, ...]) -> str:
    """Return the path of a key, such as ``frontend.corners``."""
    return ".".join(str(part) for part in location)


def sentence(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the first problem by the dotted path of its key, with a suggestion for a mistyped one."""
    problem = error.errors(include_url=False)[0]
    location = problem["loc"]
    path = dotted(location)
    if problem["type"] == "extra_forbidden":
        near = get_close_matches(str(location[-1]), _keys(model, location[:-1]), n=1)
        hint = f"; did you mean {dotted((*location[:-1], near[0]))}?" if near else ""
        return f"{path} is not a known key{hint}"
    if problem["type"] == "missing":
        return f"{path} is missing"
    value = repr(problem["input"])
    return f"{path} = {value if len(value) <= 80 else value[:77] + '...'}: {problem['msg']}"


def _keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None or not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            return []
        model = field.annotation
    return list(model.model_fields)
