// npm install react react-dom PATH/smplxpp-player-0.1.0.tgz (web/README.md makes it), then any bundler:
//     npx esbuild main.jsx --bundle --jsx=automatic --outfile=main.js
// In a page of Vite these are src/main.jsx, Avatar.jsx and Talk.jsx, and me.avatar and lips.safetensors lie in public/.
import { StrictMode, useCallback, useRef, useState } from "react";
import { createRoot } from "react-dom/client";
import { Avatar } from "./Avatar.jsx";
import { Talk } from "./Talk.jsx";

function App() {
  const guide = useRef(null), [status, setStatus] = useState("Opening"), [near, setNear] = useState(false);
  const [talks, setTalks] = useState(false);
  const ready = useCallback(({ name }) => setStatus(`${name} is here`), []);
  const speak = () => {
    // Visemes of a service (Azure's numbers, Oculus' or Polly's names) come with its sound: {audio, visemes}.
    const visemes = ["PP", "aa", "nn", "aa", "PP", "O", "SS", "E"].map((viseme, k) => ({ viseme, start: 0.14 * k }));
    guide.current.say({ visemes }).then(() => setStatus("Said"), (error) => setStatus(error.message));
    setStatus("Speaking");
  };
  return (
    <main>
      <h1>React</h1>
      <Avatar ref={guide} url="me.avatar" lips="lips.safetensors" view={near ? "chest" : "whole"} background="#e9eef7"
        style={{ width: 320, height: 420, borderRadius: 16 }} onReady={ready} onError={(error) => setStatus(error.message)} />
      <p role="status">{status}</p>
      <button onClick={speak}>Speak</button> <button onClick={() => setNear(!near)}>{near ? "All of her" : "Nearer"}</button>{" "}
      {talks ? <Talk avatar={guide} server="/talk/" /> : <button onClick={() => setTalks(true)}>Talk</button>}
    </main>
  );
}

createRoot(document.querySelector("#root")).render(<StrictMode><App /></StrictMode>);
