"""The least a command built on typer does: what `busway read` is compared with at start-up."""

import typer


def main(url: str = "tcp://127.0.0.1", count: int = 1) -> None:
    typer.echo(f"{url} {count}")


typer.run(main)
