"""Running a notebook as a user does, in a kernel of its own."""

import json
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

from tests.support.waiting import PATIENCE_S


def run_notebook(path: Path, expression: str = "None") -> tuple[Any, Any]:
    """Run all cells of a notebook in a new kernel, whose current folder is that of this process.

    Parameters
    ----------
    path
        File of the notebook.
    expression
        Expression that the kernel evaluates at the end. Its value must be convertible to JSON.

    Returns
    -------
    notebook : nbformat.NotebookNode
        Notebook with the outputs of its cells.
    value
        Value of the expression.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        If a cell raises an exception.
    """
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({expression}))"))
    client = NotebookClient(notebook, kernel_name="python3", timeout=round(PATIENCE_S))
    client.create_kernel_manager().transport = "ipc"  # a port could be taken by another test
    client.execute()
    (output,) = notebook.cells.pop().outputs
    return notebook, json.loads(output.text)


def list_output_data(notebook: Any) -> list[dict[str, str]]:
    """Return the data of all outputs by media type. A printed text has the type "text/plain"."""
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return [dict(output.get("data") or {"text/plain": output.text}) for output in outputs]
