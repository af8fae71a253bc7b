// The WebAssembly engine behind a few functions. bindings/web/src/lib.rs describes its side.

const JSON_REPLY = 0;
const ERROR_REPLY = 1;

/** An error with the engine's own text. */
export class EngineError extends Error {}

export class Engine {
  #wasm;

  /** Loads the engine of that file in the page's folder. */
  static async load(file) {
    const url = new URL(file, import.meta.url);
    const response = await fetch(url).catch(() => ({ statusText: "no answer" }));
    if (!response.ok) {
      throw new EngineError(`The engine cannot be loaded (${url}: ${response.status ?? ""} ${response.statusText}). Load the page again; if this stays, its folder lacks the file.`);
    }
    return Engine.of(await WebAssembly.compile(await response.arrayBuffer()));
  }

  /** An engine of its own from compiled code, which a worker can share. */
  static async of(module) {
    const { exports } = await WebAssembly.instantiate(module);
    const engine = new Engine(module, exports);
    engine.#reply(() => exports.environments());
    return engine;
  }

  constructor(module, wasm) {
    this.module = module;
    this.#wasm = wasm;
  }

  /** Executes a request of bindings/web/src/request.rs. Returns its answer: JSON or bytes. */
  request(request) {
    this.#put(new TextEncoder().encode(JSON.stringify(request)));
    return this.#reply(() => this.#wasm.call());
  }

  /** Opens a trace file, replays it and makes it the current game. */
  open(bytes) {
    this.#put(bytes);
    return this.#reply(() => this.#wasm.open());
  }

  /** Reads an agent's file. Returns its description; the agent can then play the environment that it was trained in. */
  loadAgent(bytes) {
    this.#put(bytes);
    return this.#reply(() => this.#wasm.load_agent());
  }

  /** Steps every environment of the wall. */
  stepWall(count) {
    return this.#reply(() => this.#wasm.step_wall(count));
  }

  /** The game's observation, as a picture of the size of its environment's frame. */
  observation({ width, height }) {
    return this.#picture(this.#wasm.observation(), width, height);
  }

  /** The game's ground-truth view, as a picture of the size of its environment's frame. */
  view({ width, height }) {
    return this.#picture(this.#wasm.view(), width, height);
  }

  /** The wall, as a picture of the size in the answer to the wall's request. */
  wall(width, height) {
    return this.#picture(this.#wasm.draw_wall(), width, height);
  }

  #put(bytes) {
    const place = this.#wasm.input(bytes.length);
    new Uint8Array(this.#wasm.memory.buffer, place, bytes.length).set(bytes);
  }

  #output() {
    return new Uint8Array(this.#wasm.memory.buffer, this.#wasm.output(), this.#wasm.output_length());
  }

  #reply(call) {
    let kind;
    try {
      kind = call();
    } catch (trap) {
      const said = new TextDecoder().decode(this.#output());
      throw new Error(`the engine failed: ${said || trap.message}; load the page again`);
    }
    const output = this.#output();
    if (kind === ERROR_REPLY) throw new EngineError(new TextDecoder().decode(output));
    return kind === JSON_REPLY ? JSON.parse(new TextDecoder().decode(output)) : output.slice();
  }

  #picture(place, width, height) {
    return new ImageData(new Uint8ClampedArray(this.#wasm.memory.buffer, place, width * height * 4), width, height);
  }
}
