"""`stagectl profile check`, `show` and `list`."""

from typing import Any

from rich.markup import escape
from rich.table import Table
from rich.tree import Tree

from drivers.arming import needed_objects
from drivers.canopen_master import eds_problem
from stagectl.commands.answer import Answer, Voice
from stagectl.errors import ProfileError
from stagectl.profile import Profile, list_profiles, load_profile
from stagectl.units import unit_of


def check(voice: Voice, profile: str) -> Answer:
    """Load a profile and its EDS files; ProfileError says everything that is wrong with it."""
    found = load_profile(profile)
    check_eds(found)
    remarks = _repeated_effects(found)
    load_ratio = found.worst_bus_load_ratio
    shown = [
        f"[green]✓[/] {found.name}: every key known, every number within its limits",
        f"  axes {', '.join(found.axes)}; {found.cycle.rate_hz:g} Hz; law {found.control.law}; "
        f"{len(found.effects)} effects; CAN at most {100.0 * load_ratio:.0f} % full",
        f"  [dim]{found.source_path}[/]",
    ]
    limp, braking = found.limp_deceleration_m_per_s2, found.macro.stop_deceleration_m_per_s2
    if limp is not None and not braking <= limp:
        shown.insert(
            2,
            f"  [yellow]without a sensor[/] the macro brakes at {braking:g} m/s^2, and a limp micro keeps off its "
            f"stops up to {limp:.2g} m/s^2 only: its stops must bear it",
        )
    shown += [f"  [yellow]{escape(remark)}[/]" for remark in remarks]
    data = {
        "profile": found.name,
        "path": found.source_path,
        "sha256": found.sha256,
        "axes": list(found.axes),
        "worst_bus_load_ratio": load_ratio,
        "limp_deceleration_m_per_s2": limp,
        "remarks": remarks,
    }
    return Answer(data, shown)


def check_eds(profile: Profile) -> None:
    """Refuse EDS files that arming could not use. Errors: ProfileError."""
    problems: list[str] = []
    for name in profile.axes:
        axis, is_macro = profile.axis(name), name == "macro"
        objects = needed_objects(profile.macro.mode if is_macro else "torque", homes=is_macro)
        if axis.temperature is not None:
            objects.append((axis.temperature.index, axis.temperature.subindex))
        identity = (axis.identity.vendor_id, axis.identity.product_code)
        problem = eds_problem(profile.eds_path(name), axis.node_id, identity, objects)
        if problem:
            problems.append(f'{profile.source_path}: {name}.eds = "{axis.eds}": {problem}')
    if problems:
        raise ProfileError("\n".join(problems))


def _repeated_effects(profile: Profile) -> list[str]:
    """Name the effects that stand twice at one place; both act there, and one of them may be a slip of the pen."""
    first: dict[tuple[str, str], int] = {}
    remarks: list[str] = []
    for number, table in enumerate(profile.effects):
        key = (table["name"], table["acts_on"])
        earlier = first.setdefault(key, number)
        if earlier != number:
            again = f"effects[{number}] is {key[0]} on {key[1]}, as effects[{earlier}] is"
            remarks.append(f"{again}: both act; remove one if one is meant")
    return remarks


def show(voice: Voice, profile: str) -> Answer:
    """Show a profile with its defaults filled in."""
    found = load_profile(profile)
    effective = found.effective()
    tree = Tree(f"[bold]{found.name}[/]  [dim]{found.source_path}[/]")
    _grow(tree, effective)
    return Answer({"profile": effective, "path": found.source_path, "sha256": found.sha256}, [tree])


def _grow(tree: Tree, values: dict[str, Any]) -> None:
    for key, value in values.items():
        if isinstance(value, dict):
            _grow(tree.add(f"[cyan]{key}[/]"), value)
        elif isinstance(value, list | tuple) and value and all(isinstance(item, dict) for item in value):
            for number, item in enumerate(value):
                _grow(tree.add(f"[cyan]{key}[/] {item.get('name', number)}"), item)
        else:
            unit = unit_of(key)
            shown = f"{value:.9g}" if isinstance(value, float) else str(value)
            tree.add(f"{key} = {escape(shown)}" + (f" [dim]{unit}[/]" if unit not in (None, "1") else ""))


def names(voice: Voice) -> Answer:
    """List every profile that a bare name can mean, with what is wrong where something is."""
    table = Table("name", "axes", "rate", "law", "file", box=None, pad_edge=False, header_style="bold")
    table.columns[-1].overflow = "fold"
    data = []
    for name in list_profiles():
        try:
            found: Profile | None = load_profile(name)
            problem = ""
        except ProfileError as error:
            found, problem = None, str(error)
        if found is None:
            table.add_row(name, "", "", "", f"[red]{problem.splitlines()[0]}[/]")
        else:
            rate = f"{found.cycle.rate_hz:g} Hz"
            table.add_row(name, " + ".join(found.axes), rate, found.control.law, str(found.source_path))
        data.append({"name": name, "path": None if found is None else found.source_path, "problem": problem})
    return Answer({"profiles": data}, [table])
