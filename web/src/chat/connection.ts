/** The websocket to the page's server, which is opened again when it is lost. */

/** Seconds until it is tried again: each time longer. */
const FIRST = 0.5, LONGEST = 8;
/** The server's code of a conversation that another page has taken over. */
const REPLACED = 4001;

/** What the server tells: an object with a kind. */
export interface Told {
  kind: string;
  [name: string]: unknown;
}

export class Connection {
  onopen: () => void = () => {};
  /** It is gone; `final`: for good. */
  onlost: (final: boolean) => void = () => {};
  ontold: (told: Told) => void = () => {};
  onframes: (data: ArrayBuffer) => void = () => {};
  private socket: WebSocket | null = null;
  private wait = FIRST;

  constructor(private readonly secret: string) {}

  get open(): boolean {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  connect(): void {
    const socket = new WebSocket(`ws://${location.host}/${this.secret}`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.wait = FIRST;
      this.onopen();
    };
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (typeof data === "string") this.ontold(JSON.parse(data) as Told);
      else this.onframes(data);
    };
    socket.onclose = ({ code }) => {
      const final = code === REPLACED;
      this.onlost(final);
      if (final) return;
      setTimeout(() => this.connect(), 1000 * this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST);
    };
  }

  /** Sends, if there is somebody: an object, or samples. */
  send(message: object | Int16Array): boolean {
    if (!this.open) return false;
    this.socket!.send(message instanceof Int16Array ? message as Int16Array<ArrayBuffer> : JSON.stringify(message));
    return true;
  }
}
