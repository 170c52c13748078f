// Sorting beside the page: in a worker, while the page draws on with the last order; here where workers are refused.

// In the worker: keeps the shapes of the first message, and answers each later one with its order.
function answerSorts(near) {
  let order = null;
  onmessage = ({ data }) => {
    if (data.shapes) {
      order = depthOrder(data.shapes, near);
      return;
    }
    const rows = order(data.axis, data.position, data.ranges).slice();
    postMessage({ number: data.number, rows }, [rows.buffer]);
  };
}

// A worker that sorts, made of this page's own functions: it needs no file and no network. Null where it is refused.
function sortingWorker(shapes, near) {
  const source = [
    `"use strict"; const dot = ${dot};`, radixPass, addShifts, depthOrder, answerSorts, `answerSorts(${near});`,
  ];
  try {
    const address = URL.createObjectURL(new Blob([source.join("\n")], { type: "text/javascript" }));
    const worker = new Worker(address);
    worker.postMessage({ shapes });
    return worker;
  } catch {
    return null;
  }
}

// What an order depends on, as numbers: equal ones need no new order.
function sortKey(axis, position, ranges) {
  const numbers = ({ row, pose, weights }) => [row, ...(pose || [NaN]), ...(weights || [])];
  return [...axis, ...position, ...ranges.flatMap(numbers)];
}

const sameKey = (a, b) => a.length === b.length && a.every((x, i) => Object.is(x, b[i]));

// Returns { now, later, settled }. now(axis, position, ranges) gives the order at once; later(…) has it sorted unless
// nothing has changed, and calls sorted(rows) when that is done; of what is asked for meanwhile, the last is sorted
// next. settled() says whether nothing is under way.
function sorterOf(shapes, near, sorted) {
  const here = depthOrder(shapes, near);
  let [worker, number, last, running, waiting] = [sortingWorker(shapes, near), 0, [], null, null];
  const start = (wanted) => {
    running = { ...wanted, number: ++number };
    worker.postMessage(running);
  };
  const finish = (rows) => {
    running = null;
    const next = waiting;
    waiting = null;
    if (next) start(next);
    sorted(rows);
  };
  const giveUp = () => {
    const asked = waiting || running;
    [worker, running, waiting] = [null, null, null];
    if (asked) sorted(here(asked.axis, asked.position, asked.ranges));
  };
  if (worker) {
    worker.onmessage = ({ data }) => running && data.number === running.number && finish(data.rows);
    worker.onerror = giveUp;
  }
  const now = (axis, position, ranges) => {
    last = sortKey(axis, position, ranges);
    [running, waiting] = [null, null];
    return here(axis, position, ranges);
  };
  const later = (axis, position, ranges) => {
    const key = sortKey(axis, position, ranges);
    if (sameKey(key, last)) return;
    if (!worker) {
      sorted(now(axis, position, ranges));
      return;
    }
    last = key;
    if (running) waiting = { axis, position, ranges };
    else start({ axis, position, ranges });
  };
  return { now, later, settled: () => !running && !waiting };
}
