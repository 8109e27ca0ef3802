/** A thread that takes slices of what the kernels do, for the rest of its life (`smplxpp/native/web/threads.cpp`). */

/** The thread, as TypeScript's library for pages does not know it. */
const thread = self as unknown as { onmessage: (event: MessageEvent<Task>) => void };

interface Task {
  module: WebAssembly.Module;
  memory: WebAssembly.Memory;
  /** Address of the end of a stack: it grows downwards. */
  stack: number;
}

thread.onmessage = ({ data: { module, memory, stack } }) => {
  const { exports } = new WebAssembly.Instance(module, { env: { memory } });
  (exports.__stack_pointer as WebAssembly.Global).value = stack;
  (exports.smplxpp_web_help as () => void)();
};
