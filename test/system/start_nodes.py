"""
Starts nodes as processes of their own, copies of this one, which has loaded what they share.

Arguments: a JSON file with a list of package, executable, arguments and log. It ends with its
standard input. Prints a line when all are started, and one for each that ends.
"""

import os

# Libraries with threads of their own cannot be copied.
os.environ |= dict.fromkeys(
    ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS', 'MKL_NUM_THREADS'), '1'
)

import json
import select
import sys
from pathlib import Path

from maasi_sim.run.processes import NodeProcess, find_executable
from maasi_sim.warm_up import main_of, prepare_copies, warm_up_search

warm_up_search()
prepare_copies()
processes = []
for item in json.loads(Path(sys.argv[1]).read_text()):
    command = [str(find_executable(item['package'], item['executable'])), *item['arguments']]
    process = NodeProcess(item['name'], command, Path(item['log']))
    process.main = main_of(item['package'], item['executable'])
    process.start()
    processes.append(process)
print('started', flush=True)
while not select.select([sys.stdin], [], [], 0.1)[0]:
    for process in list(processes):
        if not process.running:
            processes.remove(process)
            print(f'{process.name} {process.how_it_ended()}', flush=True)
